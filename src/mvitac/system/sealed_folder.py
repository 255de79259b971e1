"""A folder that describes itself: a sealed JSON file with a digest of every other file. Artifacts and exports are such."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mvitac.system.files import digest_file, read_json, write_json


@dataclass(frozen=True)
class SealedFolder:
    """What one kind of folder holds."""

    name: str  # of the JSON file
    format: str
    version: int
    command: str  # writes the folder
    required: frozenset[str]  # names of its files
    optional: frozenset[str] = frozenset()

    def write(self, folder: Path, about: dict[str, Any]) -> None:
        """Describe the files that ``folder`` now has."""
        known = {"format": self.format, "format_version": self.version}
        files = {path.name: digest_file(path) for path in sorted(folder.iterdir())}
        write_json(folder / self.name, {**known, **about, "files": files}, sealed=True)

    def read(self, folder: Path) -> dict[str, Any]:
        """The description of ``folder``, after checking every file against its digest; ValueError if one differs."""
        path = folder / self.name
        given = read_json(path, f"the output of `{self.command}`")
        named = (given.get("format"), given.get("format_version")) if isinstance(given, dict) else None
        if named != (self.format, self.version):
            raise ValueError(f"{path} is not {self.format} {self.version}: write it with `{self.command}`")
        files = given.get("files")
        if not isinstance(files, dict) or not self.required <= files.keys() <= self.required | self.optional:
            allowed = ", ".join(sorted(self.required | self.optional))
            raise ValueError(f"{path} lacks files or names others than {allowed}: refused")
        for name, expected in files.items():
            if not (folder / name).is_file() or digest_file(folder / name) != expected:
                raise ValueError(f"{folder / name} is missing or does not match its digest: copy it again")
        return given


_REQUIRED = frozenset(("model.safetensors", "run.json"))
_OPTIONAL = frozenset(("probes.safetensors", "trained_on.safetensors", "README.md"))
ARTIFACT = SealedFolder("artifact.json", "mvitac-artifact", 2, "mvitac publish", _REQUIRED, _OPTIONAL)
"""What ``mvitac publish`` writes (``deploy.artifact``)."""
