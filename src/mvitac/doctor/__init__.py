"""`mvitac data check`: what is wrong with a dataset, item by item, before anybody trains on it.

    looks.py     one pass over the images: thumbnails, ranges, exact digests
    pictures.py  what images alone tell: constant, grayscale, red and blue swapped, vision and touch swapped, out of step
    tables.py    what the table tells: labels, classes, leaks between splits, sensors, numbers, published counts
    copies.py    exact and near duplicates across splits
    glance.py    a source packed as thumbnails, so that it can be checked before it is packed
    sheet.py     the suspicious rows as a picture

A check returns a ``Finding``; it never changes anything. Heuristics say "look", facts say "broken".
"""

from mvitac.doctor.finding import Finding, exit_code
from mvitac.doctor.glance import examine, examine_pack, examine_source

__all__ = ["Finding", "examine", "examine_pack", "examine_source", "exit_code"]
