"""Provenance of a result: library versions, the machine and the git commit."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

LIBRARIES = (
    *("mvitac", "torch", "torchvision", "timm", "numpy", "scikit-learn", "pyarrow", "mujoco-core"),
    *("pillow", "av", "h5py"),  # what decodes a pack's images
)


def provenance() -> dict[str, Any]:
    """Versions, machine and git commit to stand beside a result."""
    versions = {}
    for library in LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[library] = importlib.metadata.version(library)
    return {
        "python": platform.python_version(),
        "versions": versions,
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "commit": git_commit(),
    }


def git_commit() -> str | None:
    """Commit of the checkout this package is imported from, '+' appended when it has changes; None outside one."""
    here = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        top = Path(git("rev-parse", "--show-toplevel"))
        if here != top / "src" / "mvitac" / "system":
            return None  # installed below somebody else's repository
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", "src") else "")
    except (OSError, subprocess.SubprocessError):
        return None
