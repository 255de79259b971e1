"""``python -m mvitac`` is the command ``mvitac``."""

from mvitac.cli.main import main

raise SystemExit(main())
