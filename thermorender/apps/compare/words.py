"""Words of reports."""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 pose", "2 poses"."""
    return f"{number} {noun}{'s' * (number != 1)}"
