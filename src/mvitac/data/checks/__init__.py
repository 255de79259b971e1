"""`mvitac data check`: what is wrong with a dataset, item by item, before anybody trains on it.

    examine.py         all checks of a pack, or of a source packed as thumbnails before it is packed
    image_stats.py     one pass over the images: thumbnails, ranges, exact digests
    image_checks.py    what images alone tell: constant, grayscale, red and blue swapped, modalities swapped, out of step
    table_checks.py    what the table tells: labels, classes, leaks between splits, sensors, numbers, published counts
    duplicates.py      exact and near duplicates across splits
    contact_sheet.py   the suspicious rows as a picture

A check returns a ``Finding``; it never changes anything. Heuristics say "look", facts say "broken".
"""
