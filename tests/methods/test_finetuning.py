"""Fine-tuning as a method: heads alone or all, shares of the labels, exact resumes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvitac.data.pack import Pack
from mvitac.methods.supervised import SupervisedConfig
from mvitac.model_files import fresh, load
from mvitac.run import Optim
from mvitac.training.loop import train
from support.training_runs import assert_equal_weights, power_cut, smoke


def test_heads_alone_leave_the_trunks_as_they_were(pack: Pack, tmp_path: Path) -> None:
    """Weights and statistics of BatchNorm; from another run's weights it is a linear probe."""
    method = SupervisedConfig(train="head", share=0.7)
    run = smoke(pack, method=method, steps=6, checkpoint_every=2, eval_every=0, optim=Optim(name="adamw", lr=3e-3))
    train(run, tmp_path / "straight", quiet=True)
    with power_cut(3), pytest.raises(RuntimeError, match="power cut"):
        train(run, tmp_path / "cut", quiet=True)
    train(run, tmp_path / "cut", resume=True, quiet=True)
    assert_equal_weights(tmp_path / "straight", tmp_path / "cut")
    start, end = fresh(run, pack.spec, pack.size), load(tmp_path / "cut")
    before, after = start.encoders.state_dict(), end.encoders.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    heads = zip(start.classifiers.parameters(), end.classifiers.parameters(), strict=True)
    assert not any(torch.equal(a, b) for a, b in heads)


def groups_of(pack: Pack, rows: np.ndarray) -> set[str]:
    return set(pack.column("group")[rows].astype(str))


def test_shares_are_nested_have_every_class_and_leave_test_alone(pack: Pack) -> None:
    whole = SupervisedConfig(tasks=("pattern",))
    everything = groups_of(pack, whole.training_rows(pack))
    before: set[str] = set()
    for share in (0.05, 0.2, 0.5, 1.0):
        rows = replace(whole, share=share).training_rows(pack)
        found = groups_of(pack, rows)
        assert before <= found <= everything and len(found) == max(3, round(share * len(everything)))
        assert set(pack.labels("pattern")[rows]) == {0, 1, 2}
        assert set(rows) == {r for r in whole.training_rows(pack) if pack.column("group")[r] in found}  # whole groups
        before = found
    draws = [replace(whole, share=0.3, draw=seed).training_rows(pack).tolist() for seed in (1, 2, 3)]
    assert draws[0] != draws[1] and draws[1] != draws[2]


def test_held_out_groups_are_of_the_drawn_ones(pack: Pack) -> None:
    for share in (0.5, 1.0):
        config = SupervisedConfig(tasks=("pattern",), share=share)
        drawn, learned = config.training_rows(pack), replace(config, hold_out=True).training_rows(pack)
        held = np.setdiff1d(drawn, learned)
        assert len(held) and set(learned) <= set(drawn) and not groups_of(pack, held) & groups_of(pack, learned)
        assert set(pack.labels("pattern")[learned]) == {0, 1, 2}
        assert set(pack.column("split")[held]) == {"val"}  # where there are enough of them
    with pytest.raises(ValueError, match="3 labelled instances are too few to hold some out"):
        SupervisedConfig(tasks=("pattern",), share=0.05, hold_out=True).training_rows(pack)
