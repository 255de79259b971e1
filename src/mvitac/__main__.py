"""``python -m mvitac`` runs the command ``mvitac``."""

from mvitac.cli.main import main

raise SystemExit(main())
