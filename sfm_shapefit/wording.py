"""How numbers are said: counts with their noun, and figures in which rounding is zero."""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the singular for one."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def rounded(value: float, smallest: float = 1e-9, digits: int = 4) -> str:
    """Return a number in so many digits; one that is smaller than `smallest` is 0."""
    return "0" if abs(value) < smallest else f"{value:.{digits}g}"
