"""The exception for a mistake in the user's input, and the warning of an effect that may surprise."""

# Longest message, and how much of its end, which says how to mend it, is kept of a longer one.
_LONGEST, _END = 2500, 800


class ThermorenderError(ValueError):
    """A mistake in the user's input: a file, a key, a column, an argument or the machine's set-up.

    The message is one sentence: which argument or key, what arrived, what is allowed, how to fix it.
    The command line prints it without a traceback and exits with status 2. Characters that do not print, such as line
    ends in a file's name, are replaced by their codes, so a message is one line and cannot control the terminal. A
    message that quotes a very long text loses its middle.
    """

    def __init__(self, message: object = "") -> None:
        text = "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in str(message))
        super().__init__(text if len(text) <= _LONGEST else f"{text[: _LONGEST - _END]} … {text[-_END:]}")


class ThermorenderWarning(UserWarning):
    """A call did what it was asked for, with an effect that its user may not expect."""


def shortened(text: str, length: int = 160) -> str:
    """Return a user's text for a message, cut after `length` characters."""
    return text if len(text) <= length else f"{text[:length]}…"
