"""The one exception for wrong use: the command line turns it into one sentence and exit code 2."""

from __future__ import annotations


class UsageError(Exception):
    """Wrong input: the message says in one sentence what was wrong and what would be right."""
