"""Pages: what comes from outside stays text, pictures survive, and nothing is loaded or overwritten."""

import base64
import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from markupsafe import escape
from present import present

from nerfcli.errors import UserError
from nerfcli.output import Output
from nerfcli.pages import page
from nerfcli.photos.images import reduced

EVIL = "</script><script>alert(1)</script><b>\u2028&\"'"


def simple(path: Path = Path("here"), *, script: str = "") -> str:
    return page.page_html(title=EVIL, mark=page.Mark("test", path), style="p{}", body="<p>$body</p>", script=script)


def test_a_page_allows_no_loading_and_no_script_that_it_has_not():
    policy = re.compile('Content-Security-Policy" content="([^"]+)"')
    without, with_script = (present(policy.search(simple(script=script))) for script in ("", "let a = 1"))
    assert without[1].startswith("default-src 'none'")
    assert "script-src" not in without[1]
    assert "script-src 'unsafe-inline'" in with_script[1]
    assert "<script>let a = 1</script>" in simple(script="let a = 1")
    assert "<p>$body</p>" in simple()


def test_titles_and_what_fills_a_template_are_text():
    assert "<b>" not in simple()
    assert escape(EVIL) in simple()
    scan = {"findings": [], "not_checked": [(EVIL, EVIL)], "pictures": [(EVIL, EVIL, EVIL)]}
    made = page.rendered("scan.html", title=EVIL, **scan)
    assert "<script>" not in made
    assert made.count(escape(EVIL)) == 7


@examples(60)
@given(
    st.recursive(
        st.text() | st.integers() | st.none(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
        max_leaves=25,
    )
)
def test_data_reads_back_as_it_was_and_cannot_end_its_element(content):
    """The standard's rule: only "<" can end or change the state of a script element; JSON.parse undoes the escapes."""
    element = page.data_element("data", content)
    inner = element.removeprefix('<script type="application/json" id="data">').removesuffix("</script>")
    assert "<" not in inner
    assert json.loads(inner) == content


def test_data_that_json_has_no_word_for_is_refused():
    with pytest.raises(ValueError, match="JSON"):
        page.data_element("data", [float("nan")])


def test_pictures_read_back_by_another_reader():
    """PNG exactly, channels in order; JPEG within what its quality allows, and no larger than asked for."""
    ramp = np.linspace(0, 255, 64).astype(np.uint8)
    picture = np.stack([np.tile(ramp, (48, 1)), np.full((48, 64), 30, np.uint8), np.zeros((48, 64), np.uint8)], axis=-1)
    uri = page.data_uri(page.png_bytes(picture), "png")
    data = base64.b64decode(uri.removeprefix("data:image/png;base64,"))
    again = present(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    np.testing.assert_array_equal(again[..., ::-1], picture)
    small = present(cv2.imdecode(np.frombuffer(page.jpeg_bytes(reduced(picture, 32)), np.uint8), cv2.IMREAD_COLOR))
    assert small.shape == (24, 32, 3)
    wanted = picture.reshape(24, 2, 32, 2, 3).mean((1, 3))
    assert np.abs(small[..., ::-1] - wanted).max() < 8


def test_a_page_about_a_folder_whose_name_is_not_utf_8(tmp_path):
    """The name is shown with an escape, in the page's data too, and the page is known again."""
    source, path = tmp_path / os.fsdecode(b"K\xfcche"), tmp_path / "page.html"
    body, mark = page.data_element("data", {"name": source.name}), page.Mark("test", source)
    page.write_page(page.page_html(title=source.name, mark=mark, style="", body=body), path)
    text = path.read_text(encoding="utf-8")
    assert r"<title>K\udcfcche: nerfcli test</title>" in text
    assert r'{"name":"K\udcfcche"}' in text
    page.claim_page(Output(), path, mark, about="capture")


def test_only_a_page_of_the_same_kind_and_source_is_replaced(tmp_path):
    path, mark = tmp_path / "page.html", page.Mark("test", tmp_path)
    page.claim_page(Output(), path, mark, about="capture")
    page.write_page(simple(tmp_path), path)
    page.claim_page(Output(), path, mark, about="capture")
    assert str(tmp_path) not in path.read_text(encoding="utf-8")
    for other in (page.Mark("bench", tmp_path), page.Mark("test", tmp_path.parent)):
        with pytest.raises(UserError, match="not a page of this capture"):
            page.claim_page(Output(), path, other, about="capture")
