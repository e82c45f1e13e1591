"""The list of mutants matches the code; `benchmarks/mutants.py` tests whether they are killed."""

from pathlib import Path

import pytest
from mutants import read_groups

import nerfcli

ROOT = Path(nerfcli.__file__).parent


@pytest.mark.parametrize("group", read_groups(), ids=lambda group: group.file)
def test_every_mutant_breaks_one_place(group):
    text = (ROOT / group.file).read_text(encoding="utf-8")
    assert [old for old, _ in group.mutants if text.count(old) != 1] == []
    assert len(set(group.mutants)) == len(group.mutants)
    assert all((ROOT.parent / "tests" / test).is_file() for test in group.tests.split())
