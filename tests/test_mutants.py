"""The list of `make mutants` fits the code; the mutants themselves are not tried here."""

import pytest
from mutants import MUTANTS, ROOT, misfit


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_changes_one_place_of_the_code(mutant):
    assert misfit(mutant, ROOT) == ""
    assert mutant.old != mutant.new


def test_no_two_mutants_have_one_name():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)
