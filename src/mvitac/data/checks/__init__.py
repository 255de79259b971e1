"""`mvitac data check`: finds errors in a dataset before training.

A check returns a ``Finding`` and changes nothing. Heuristics give the verdict "look", facts "broken".
"""
