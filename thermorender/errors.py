"""The one exception a user's mistake raises: a single sentence that says what to mend."""


class ThermorenderError(ValueError):
    """A mistake in what the user gave: a file, a key, a column, an argument or the machine's set-up.

    The message is one sentence: which argument or key, what arrived, what is allowed, how to mend it.
    The command line prints it without a traceback and exits with status 2. What a file's names hold of line ends and
    other signs that do not print is shown by their codes: a message stays one line, and steers no terminal.
    """

    def __init__(self, message: object = ""):
        super().__init__("".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in str(message)))


def shortened(text: str, length: int = 160) -> str:
    """Return a text of the user's for a message, cut where a sentence would drown in it."""
    return text if len(text) <= length else f"{text[:length]}…"
