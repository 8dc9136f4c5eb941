"""Draw a contact sheet of fits: each animal from four sides, as several methods made it.

    python docs/draw_sides.py runs --protocol artemis-fixed-256-v4 --methods prior-only ours --out sides.webp

takes orbit.png of the runs below `runs`, a row a case and a column a method; of several seeds the lowest.
"""

import argparse
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from rewild4d.errors import UserError
from rewild4d.leaderboard.records import find_records

WIDTH = 640
"""Of one picture, pixels."""
TITLE = 20
"""Height of the line above a picture, pixels."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--protocol", required=True)
    parser.add_argument("--methods", nargs="+", default=["prior-only", "ours"])
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    try:
        found = pictures(given.runs, given.protocol, given.methods)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    sheet(found).save(given.out)
    print(f"{len(found)} cases: {given.out}")
    return 0


def pictures(runs: Path, protocol: str, methods: list[str]) -> dict[str, dict[str, Path]]:
    """Return each case's picture by method, of the cases that all methods have.

    Raises:
        UserError: there is no such case, or a record cannot be read.
    """
    found: dict[str, dict[str, Path]] = {}
    for folder, record in sorted(find_records(runs), key=lambda each: -each[1].seed):
        picture = folder / "orbit.png"
        if record.protocol["name"] == protocol and record.method in methods and picture.is_file():
            found.setdefault(record.case, {})[record.method] = picture
    whole = {case: {m: found[case][m] for m in methods} for case in sorted(found) if {*methods} == {*found[case]}}
    if not whole:
        wanted = " and ".join(methods)
        raise UserError(f"{runs}: expected pictures of {wanted} under {protocol} of one case or more, found none.")
    return whole


def sheet(found: dict[str, dict[str, Path]]) -> Image.Image:
    """Lay pictures out, a row a case and a column a method."""
    rows = [(case, [(method, _fitted(path)) for method, path in each.items()]) for case, each in found.items()]
    heights = [TITLE + max(image.height for _, image in row) for _, row in rows]
    page = Image.new("RGB", (WIDTH * len(rows[0][1]), sum(heights)), "white")
    draw, font, top = ImageDraw.Draw(page), ImageFont.load_default(14), 0
    for (case, row), height in zip(rows, heights, strict=True):
        for column, (method, image) in enumerate(row):
            page.paste(image, (column * WIDTH, top + TITLE))
            draw.text((column * WIDTH + 6, top + 2), f"{case}: {method}", "black", font)
        top += height
    return page


def _fitted(path: Path) -> Image.Image:
    image = Image.open(path).convert("RGB")
    return image.resize((WIDTH, image.height * WIDTH // image.width))


if __name__ == "__main__":
    sys.exit(main())
