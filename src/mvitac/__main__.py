"""``python -m mvitac`` is the command ``mvitac``."""

from mvitac.cli import main

raise SystemExit(main())
