"""The one exception that reaches a user as a paragraph instead of a traceback."""

from __future__ import annotations


class UserError(Exception):
    """Something the user can mend: says what was expected, what came, where, and what to do.

    The command line prints the message and exits with status 2.
    """
