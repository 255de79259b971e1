"""rich's console, which prints text as ``terminal.plain`` does."""

from collections.abc import Iterable
from typing import Any

import rich.console
from rich.segment import Segment

from mvitac.system.terminal import plain


class Console(rich.console.Console):
    """A console on which a label cannot contain escape sequences. All of this package prints with it."""

    def render(self, renderable: Any, options: rich.console.ConsoleOptions | None = None) -> Iterable[Segment]:
        """Segments of ``renderable``; everything that is printed passes here, rich's own sequences marked as such."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(plain(segment.text), segment.style)
