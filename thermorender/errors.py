"""The one exception a user's mistake raises: a single sentence that says what to mend."""


class ThermorenderError(ValueError):
    """A mistake in what the user gave: a file, a key, a column, an argument or the machine's set-up.

    The message is one sentence: which argument or key, what arrived, what is allowed, how to mend it.
    The command line prints it without a traceback and exits with status 2.
    """


def shortened(text: str, length: int = 160) -> str:
    """Return a text of the user's for a message, cut where a sentence would drown in it."""
    return text if len(text) <= length else f"{text[:length]}…"
