"""The exceptions that the command line turns into one sentence: wrong use (exit 2), a run that ends (1)."""

from __future__ import annotations


class UsageError(Exception):
    """Wrong input: the message says in one sentence what was wrong and what would be right."""


class RunError(Exception):
    """A run that cannot go on: the message says in one sentence why, and what becomes of it."""


class NoAnswerError(Exception):
    """Nobody answered: no receiver, a timeout, or a dead peer."""


class RefusedError(Exception):
    """The receiver answered with an error; the text is its reason."""
