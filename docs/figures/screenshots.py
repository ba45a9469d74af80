"""Takes the README's pictures from run folders: screenshots of their reports, by headless Chromium.

    python -m docs.figures.screenshots RUN_FOLDER DESK_RUN_FOLDER

Writes docs/images/{report,forces,pipe,timing}.png. Needs Chromium (Debian: apt install chromium) and Pillow.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

IMAGES = Path(__file__).parents[1] / "images"
SIZE = (1180, 4600)
QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-quic", "--hide-scrollbars",
)  # fmt: skip


def page(report: Path) -> Image.Image:
    """A picture of the whole report page."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("chromium is needed and was not found (Debian: apt install chromium)")
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "page.png"
        command = [chromium, *QUIET, f"--user-data-dir={folder}/profile", f"--window-size={SIZE[0]},{SIZE[1]}"]
        subprocess.run([*command, f"--screenshot={shot}", report.resolve().as_uri()], check=True, capture_output=True)
        return Image.open(shot).convert("RGB").copy()


def save(picture: Image.Image, box: tuple[int, int, int, int], name: str) -> None:
    """A cut-out as docs/images/<name>.png, with few colours: it is line art."""
    picture.crop(box).quantize(128).save(IMAGES / f"{name}.png", optimize=True)


def main() -> None:
    """Take all pictures."""
    run, desk = (page(Path(folder) / "report.html") for folder in sys.argv[1:3])
    for picture, name in ((run, "run"), (desk, "desk")):
        picture.save(Path(tempfile.gettempdir()) / f"{name}-page.png")
    save(run, (60, 0, 1140, 1220), "report")
    save(run, (60, 1240, 1140, 1890), "forces")
    save(run, (60, 3045, 1140, 3690), "pipe")
    save(desk, (60, 3730, 1140, 4405), "timing")


if __name__ == "__main__":
    main()
