"""Names of runs in a result: seeds of one method share a name."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mvitac.datasets.pack import PackConfig
from mvitac.model import Model
from mvitac.registry import to_json
from mvitac.run import load_run
from mvitac.shipped import BASE
from mvitac.system.files import digest


def names_of(paths: Sequence[Path], models: Sequence[Model]) -> list[str]:
    """Names of the runs: the method, the recipe if recipes differ, and the folder if runs of one name differ further.

    ValueError if two runs are the same, since they would count as two seeds.
    """
    several = len({model.run.recipe for model in models}) > 1
    own = [m.run.method.name + f" ({m.run.recipe})" * several for m in models]
    names = ["base" if path == BASE else name for name, path in zip(own, paths, strict=True)]
    alike: dict[str, dict[str, dict[int, Path]]] = {}  # name -> digest of the settings -> seed -> folder
    for name, path, model in zip(names, paths, models, strict=True):
        asked, record = load_run(path) if (path / "run.json").exists() else (model.run, {})
        # All settings but the seed, and the data. The precision is what was asked for: `auto` may differ by seed.
        settings = replace(model.run, seed=0, data=PackConfig(), precision=asked.precision).digest()
        key = digest([settings, record.get("pack") or to_json(model.run.data)])
        seeds = alike.setdefault(name, {}).setdefault(key, {})
        if model.run.seed in seeds:
            same = f"{seeds[model.run.seed]} and {path} are the same run (equal settings, seed {model.run.seed})"
            raise ValueError(f"{same}: they would count as two seeds, give one of them")
        seeds[model.run.seed] = path
    where: dict[Path, str] = {}
    for kinds in alike.values():
        folders = [list(seeds.values()) for seeds in kinds.values()]
        # Each place is the folder that a group shares or, where these are not distinct, all of the group's folders.
        places = [Path(os.path.commonpath([path.resolve() for path in group])).name for group in folders]
        if len(set(places)) < len(folders):
            places = [", ".join(map(str, group)) for group in folders]
        for group, place in zip(folders, places, strict=True):
            where |= dict.fromkeys(group, f" ({place})" if len(folders) > 1 else "")
    return [name + where[path] for name, path in zip(names, paths, strict=True)]
