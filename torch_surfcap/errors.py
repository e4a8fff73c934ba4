"""The one error that bad input raises."""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used. The message is one line: which file or camera, what was found, what was expected.

    The commands under train/ print it to stderr and exit with status 2; a program that calls the library catches it
    like any ValueError.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))
