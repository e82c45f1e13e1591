"""The files of a bench: numbers as JSON and CSV, and the page."""

import json
import shutil
from pathlib import Path
from typing import Any

from nerfcli.atomic import write_json
from nerfcli.bench.page import bench_page
from nerfcli.bench.records import PLAN, Records, emptied
from nerfcli.bench.rendering import WORK
from nerfcli.bench.sample_pictures import FOLDER
from nerfcli.bench.summary import summarised
from nerfcli.bench.tables import write_csv
from nerfcli.bench.training import KEPT_FIELD
from nerfcli.pages.embedded_pictures import data_uri
from nerfcli.pages.page import write_page

JSON, CSV, PAGE = "bench.json", "bench.csv", "bench.html"


def write_report(records: Records) -> tuple[Path, dict[str, Any]]:
    """Write bench.json, bench.csv and bench.html from the measurements so far.

    Once the bench is complete, pictures that are not on the page, from an earlier bench, are deleted.

    Returns:
        The page's path, and the content of bench.json.

    Raises:
        UserError: they cannot be written.
    """
    plan = json.loads((records.folder / PLAN).read_text(encoding="utf-8"))
    content = summarised(records, plan)
    write_json(records.folder / JSON, content)
    write_csv(content, records.folder / CSV)
    page = records.folder / PAGE
    pictures = _embedded(content, records.folder / FOLDER)
    write_page(bench_page(content, pictures, records.folder), page)
    if content["complete"]:
        for path in (records.folder / FOLDER).glob("*.jpg"):
            if path.name not in pictures:
                path.unlink()
    return page, content


def discard(folder: Path) -> None:
    """Delete only the measurements, field and work files of a bench; a folder without a bench is not changed.

    Its report and pictures stay until they are replaced: the disk may be full, or the new bench may be given up.
    """
    if not (folder / PLAN).exists():
        return
    emptied(folder)
    (folder / KEPT_FIELD).unlink(missing_ok=True)
    shutil.rmtree(folder / WORK, ignore_errors=True)


def _embedded(content: dict[str, Any], folder: Path) -> dict[str, str]:
    """Return the pictures that the points refer to, as data URIs by name."""
    parts = [content[part] for part in ("rendering", "training") if content[part]]
    names = {name for part in parts for point in part["points"] for name in point["pictures"].values()}
    names |= {part["truth"] for part in parts if "truth" in part}
    return {name: data_uri((folder / name).read_bytes(), "jpeg") for name in sorted(names) if (folder / name).exists()}
