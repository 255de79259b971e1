"""How a pack stores images, raw or as JPEG, and which requests are possible."""

from typing import Any, Literal

from mvitac.registry import unknown

Store = Literal["raw", "jpeg"]
FORMAT_VERSIONS = {"raw": 1, "jpeg": 2}  # format version by how images are stored
SUFFIXES = {"raw": ".npy", "jpeg": ".jpegs"}
QUALITY = 95


def check_request(
    size: int, workers: int, max_damaged: float = 0.0, *, store: str = "raw", quality: int = QUALITY
) -> None:
    """Raise ValueError for invalid packing options."""
    if not 8 <= size <= 1024:
        raise ValueError(f"size {size} is not possible: give the stored side in pixels, 8 to 1024")
    if not 0 <= workers <= 1024:
        raise ValueError(f"workers {workers} is not possible: give 1 to 1024 processes, or 0 for one per core")
    if not 0 <= max_damaged <= 1:
        raise ValueError(f"max_damaged {max_damaged} is not possible: give a fraction of the items, 0 to 1")
    if store not in SUFFIXES:
        raise unknown("store", str(store), SUFFIXES)
    if not 1 <= quality <= 100:
        raise ValueError(f"quality {quality} is not possible: give a JPEG quality from 1 to 100")


def stored_as(store: Store, quality: int) -> dict[str, Any]:
    """Return the storage options that identify a pack; none for raw pixels, to keep old digests valid."""
    return {} if store == "raw" else {"store": store, "quality": quality}
