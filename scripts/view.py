#!/usr/bin/env python
"""The command `rgs-mi view`, in a clone."""

from rgs_mi.cli import main

if __name__ == "__main__":
    main("view")
