"""``python -m onboard``."""

from onboard.main import main

raise SystemExit(main())
