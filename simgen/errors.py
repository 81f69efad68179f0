"""The one exception that reaches a user as a paragraph instead of a traceback."""

from __future__ import annotations


class UserError(Exception):
    """Something the user can mend: says what was expected, what came, where, and what to do.

    The command line prints the message and exits with status 2.
    """


RESTORE = (
    "move the file away and run the same render command again with the same versions installed, or "
    "put a copy of it back"
)
"""What to do about a damaged file of a set. Not to delete it: a set of other versions is refused,
and its frames cannot be made anew."""
