"""Imported once by the server that forks processes of tests, so that none of them loads networks anew."""

import gc

import torch

import mvitac.experiments.jobs
import mvitac.training.loop  # noqa: F401

torch.set_num_threads(1)
gc.freeze()  # a collection in a forked process would copy every page that it looks at
