"""The list of mutants matches the code; `benchmarks/mutants.py` tests whether they are killed."""

from collections import Counter
from pathlib import Path

import pytest
from mutant_list import GROUPS
from mutant_list_poses import POSES
from mutant_list_training import TRAINING
from mutant_list_triton import TRITON

import nerfcli

ROOT = Path(nerfcli.__file__).parent


@pytest.mark.parametrize("group", [*GROUPS, *TRAINING, *POSES, *TRITON], ids=lambda group: group.file)
def test_every_mutant_breaks_one_place(group):
    text = (ROOT / group.file).read_text(encoding="utf-8")
    assert [mutant.old for mutant in group.mutants if text.count(mutant.old) != 1] == []
    assert [mutant for mutant, count in Counter(group.mutants).items() if count > 1] == []
    assert all((ROOT.parent / test).is_file() for test in group.tests)
