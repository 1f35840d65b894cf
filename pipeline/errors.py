"""What a user can cause, as sentences."""

from __future__ import annotations


class UserError(Exception):
    """A fault the user can mend: what is wrong and where, then what to do about it.

    The runner prints both and exits with code 2, without a traceback.
    """

    def __init__(self, what: str, hint: str = "") -> None:
        super().__init__(what, hint)
        self.what = what
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.what} {self.hint}".strip()
