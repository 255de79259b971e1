"""rich's console, which prints text as ``terminal.plain`` does."""

from collections.abc import Iterable
from typing import IO, Any

import rich.console
from rich.segment import Segment

from mvitac.system.terminal import plain


class Console(rich.console.Console):
    """A console on which a label cannot contain escape sequences. All of this package prints with it."""

    @property
    def file(self) -> IO[str]:
        """Where rich writes what it has rendered: behind ``terminal``'s stream and behind rich's own, which bars add."""
        file = super().file
        return getattr(file, "rich_proxied_file", file)

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file

    def print(self, *objects: Any, soft_wrap: bool | None = None, **options: Any) -> None:
        """``soft_wrap``: one line in a pipe or a file. A terminal would break it within words, so it is wrapped there."""
        super().print(*objects, soft_wrap=bool(soft_wrap) and not self.is_terminal, **options)

    def render(self, renderable: Any, options: rich.console.ConsoleOptions | None = None) -> Iterable[Segment]:
        """Segments of ``renderable``; everything that is printed passes here, rich's own sequences marked as such."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(plain(segment.text), segment.style)
