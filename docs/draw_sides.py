"""Draw a contact sheet of fits: each animal from four sides, as two methods made it.

    python docs/draw_sides.py runs --protocol artemis-fixed-256-v4 --methods prior-only ours --out docs/sides.webp

takes orbit.png of every run below `runs`, a row a case and a column a method; of several seeds the first.
"""

import argparse
import json
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

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
    found = pictures(given.runs, given.protocol, given.methods)
    if not found:
        wanted = " and ".join(given.methods)
        print(f"{given.runs}: expected finished runs of {wanted} under {given.protocol}, found none.", file=sys.stderr)
        return 2
    sheet([[row[method] for method in given.methods] for row in found.values()], list(found), given.methods).save(
        given.out, quality=80
    )
    print(f"{len(found)} cases: {given.out}")
    return 0


def pictures(runs: Path, protocol: str, methods: list[str]) -> dict[str, dict[str, Path]]:
    """Return each case's picture by method, of cases that all methods have."""
    found: dict[str, dict[str, tuple[int, Path]]] = {}
    for path in sorted(runs.rglob("record.json")):
        record, picture = json.loads(path.read_text()), path.parent / "orbit.png"
        if record["protocol"]["name"] != protocol or record["method"] not in methods or not picture.is_file():
            continue
        case = found.setdefault(record["case"], {})
        case[record["method"]] = min(case.get(record["method"], (record["seed"], picture)), (record["seed"], picture))
    whole = {case: each for case, each in sorted(found.items()) if len(each) == len(methods)}
    return {case: {method: picture for method, (_, picture) in each.items()} for case, each in whole.items()}


def sheet(rows: list[list[Path]], cases: list[str], methods: list[str]) -> Image.Image:
    """Lay pictures out, a row a case."""
    images = [[Image.open(path).convert("RGB") for path in row] for row in rows]
    images = [[image.resize((WIDTH, image.height * WIDTH // image.width)) for image in row] for row in images]
    heights = [TITLE + max(image.height for image in row) for row in images]
    page = Image.new("RGB", (WIDTH * len(methods), sum(heights)), "white")
    draw, font, top = ImageDraw.Draw(page), ImageFont.load_default(14), 0
    for row, case, height in zip(images, cases, heights, strict=True):
        for column, (image, method) in enumerate(zip(row, methods, strict=True)):
            page.paste(image, (column * WIDTH, top + TITLE))
            draw.text((column * WIDTH + 6, top + 2), f"{case}: {method}", "black", font)
        top += height
    return page


if __name__ == "__main__":
    sys.exit(main())
