# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m addon preview SCENE …`, with pip's bpy."""

import sys

from .cli import main

sys.exit(main(sys.argv[1:]))
