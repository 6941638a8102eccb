"""Words that texts for people share."""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, such as "1 message" or "2 messages"."""
    return f"{number} {noun}{plural(number)}"


def plural(number: int) -> str:
    """Return the ending of a regular noun after this number."""
    if number == 1:
        return ""
    return "s"
