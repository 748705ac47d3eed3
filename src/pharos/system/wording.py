"""How messages say numbers."""


def many(count: int, one: str, several: str | None = None) -> str:
    """A count and its noun: "1 run", "1,200 runs", "2 classes"."""
    return f"{count:,} {one if count == 1 else several or one + 's'}"
