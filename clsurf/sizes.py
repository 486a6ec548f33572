"""Numbers of bytes as users write them."""

import re

from .errors import InputError


def parse_bytes(value, name: str = "memory_limit") -> int | None:
    """Return a number of bytes from a number or a text such as "500MB" or "2 GB"; None stays None."""
    if value is None:
        return None
    match = re.fullmatch(r"\s*([0-9.]+)\s*([kMGT]?)i?B?\s*", str(value))
    try:
        return int(float(match[1]) * 1000 ** " kMGT".index(match[2] or " "))
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected bytes or a text such as '2GB', got {value!r}") from None


def checked_budget(budget) -> int:
    """Return a budget in bytes, or raise InputError."""
    number = parse_bytes(budget, "budget")
    if number is None or number <= 0:
        raise InputError(f"budget: expected bytes or a text such as '2GB', got {budget!r}")
    return number
