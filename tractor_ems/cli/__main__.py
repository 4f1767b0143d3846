"""``python -m tractor_ems.cli``, the same as ``ems``."""

import sys

from tractor_ems.cli import main

sys.exit(main())
