"""Provenance of results: library versions, machine and git commit."""

import contextlib
import importlib.metadata
import os
import platform
import subprocess
from functools import cache, partial
from pathlib import Path
from typing import Any

LIBRARIES = (
    *("mvitac", "torch", "torchvision", "timm", "numpy", "scikit-learn", "pyarrow", "mujoco-core"),
    *("pillow", "av", "h5py"),  # what decodes a pack's images
)


def provenance() -> dict[str, Any]:
    versions = {}
    for library in LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[library] = importlib.metadata.version(library)
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    return {"python": platform.python_version(), "versions": versions, "machine": machine, "commit": git_commit()}


@cache
def git_commit() -> str | None:
    """Return the commit of the checkout this package is imported from, with '+' if it has changes; None outside one.

    As of the first call in a process, which runs the code that was there then.
    """
    top = Path(__file__).parents[3]
    if not (top / ".git").exists():
        return None
    git = partial(subprocess.run, capture_output=True, text=True, check=True, timeout=10, cwd=top)
    try:
        changed = git(["git", "status", "--porcelain", "--", "src"]).stdout.strip()
        return git(["git", "rev-parse", "HEAD"]).stdout.strip() + "+" * bool(changed)
    except (OSError, subprocess.SubprocessError):
        return None
