"""Write one page about one or more runs, with held-out photos rendered again."""

from collections.abc import Sequence
from pathlib import Path

from nerfcli.errors import UserError
from nerfcli.evaluate.photos import held_out_photos
from nerfcli.evaluate.report.page import mark_of, origin_of, page_html
from nerfcli.evaluate.report.run_facts import captures_of, labels_of, read_facts
from nerfcli.evaluate.report.views import common_names, look_at
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.pages.page import claim_page, is_made_from, write_page
from nerfcli.render.job import depth_meta
from nerfcli.training.runs.files import REPORT
from nerfcli.training.runs.run import load_run
from nerfcli.workflows.photo_depths import photo_depths
from nerfcli.workflows.views import Views, usual_depth

# A page shows at most this many held-out photos of each capture, from the worst to the best.
MOST_VIEWS = 8


def report_runs(
    runs: Sequence[Path],
    output: Output = Output(),
    *,
    keep: bool = False,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> Path:
    """Write a page about one or more runs, and return its path.

    Args:
        runs: folders that training wrote, at least one.
        output: the file to write, by default RUN/report.html, or report.html beside the first of several runs. A report
            on these runs is replaced in any case; another file only if it may be overwritten.
        keep: keep a page that was made from the same files with the same options.
        resources: threads and device to render with.
        reporter: receives messages.

    Raises:
        UserError: a folder is not a run, its photos cannot be read, or the page's path holds something else.
    """
    target = output.at(runs[0] / REPORT if len(runs) == 1 else runs[0].resolve().parent / REPORT)
    claim_page(output, target, mark_of(runs), about="report")
    resources.begin()
    opened = [load_run(path) for path in runs]
    hashes = [run.checkpoint_sha256() for run in opened]
    described = zip(opened, labels_of(runs), hashes, strict=True)
    facts = [read_facts(run, label, checkpoint_sha256=digest) for run, label, digest in described]
    depth = usual_depth(opened[0], Views("test"))
    origin = origin_of(facts, hashes, views=MOST_VIEWS, depth=depth)
    if keep and not output.overwrite and is_made_from(target, origin):
        reporter.note(f"{target} is kept: it is up to date; add --overwrite to write it again")
        return target
    names = [[] for _ in runs]
    for capture in captures_of(facts):
        shared = common_names([facts[index] for index in capture], MOST_VIEWS)
        for index in capture:
            names[index] = shared
    looks, meanings = [], []
    reporter.progress(0.0, "")
    for index, (run, about) in enumerate(zip(opened, facts, strict=True)):
        on_progress = reporter.part(index / len(runs), (index + 1) / len(runs), about.label)
        model = run.model(resources.torch_device)
        if model.sha256 != hashes[index]:
            hint = "run the command again when the training is complete"
            raise UserError(f"{run.field_path} was replaced while the report was written", hint)
        frames = [frame for frame in run.cameras.test if frame.name in names[index]]
        compared = [photo for photo in held_out_photos(run, frames) if not photo.is_hidden]
        photos = photo_depths(run, model, Reporter(reporter.note))
        looks.append(look_at(model, compared, depth=depth, photo_depths=photos, on_progress=on_progress))
        meanings.append(depth_meta(model, depth))
    write_page(page_html(facts, looks, depths=meanings, origin=origin), target)
    return target
