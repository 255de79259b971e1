"""`mvitac data check`: finds errors in a dataset before training.

    examine.py         all checks of a pack, or of a source packed as thumbnails; the suspicious rows for a sheet
    image_stats.py     one pass over the images: thumbnails, standard deviations, digests
    image_checks.py    checks of images: constant, red and blue swapped, modalities swapped, time offset
    table_checks.py    checks of the table: labels, classes, leaks between splits, sensors, give-aways
    duplicates.py      exact and near duplicates across splits

A check returns a ``Finding`` and changes nothing. Heuristics give the verdict "look", facts "broken".
"""
