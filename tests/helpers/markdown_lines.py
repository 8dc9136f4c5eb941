"""Cells of a Markdown table."""


def cells(text: str, *starts: str) -> list[str]:
    """The cells of the one table line that begins with these."""
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    (line,) = [line for line in lines if line[: len(starts)] == list(starts)]
    return line[len(starts) :]
