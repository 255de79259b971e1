"""Figures of an HTML page."""

import re
from base64 import b64decode


def drawings(page: str) -> list[str]:
    return [b64decode(found).decode() for found in re.findall(r'src="data:image/svg\+xml;base64,([^"]*)"', page)]
