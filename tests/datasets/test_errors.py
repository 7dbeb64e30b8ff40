"""What a reader stumbles over becomes the user's error, and what is one already stays as it is."""

from __future__ import annotations

import pytest

from thermogrip.datasets.errors import UserError, as_user_error, os_faults


def test_an_exception_of_the_kinds_is_told_with_its_place_and_no_other():
    with pytest.raises(UserError) as found, as_user_error(KeyError, "is damaged ({error})", file="a", row=2):
        raise KeyError("x" * 300)
    assert str(found.value) == f"a, row 2: is damaged ('{'x' * 199})"
    assert isinstance(found.value.__cause__, KeyError)
    with pytest.raises(IndexError), as_user_error(KeyError, "is damaged"):
        raise IndexError


def test_a_users_error_keeps_its_own_words():
    own = UserError("is too large", file="b")
    with pytest.raises(UserError) as found, as_user_error(Exception, "is damaged", file="a"):
        raise own
    assert found.value is own


def test_what_the_system_refuses_names_the_path():
    with pytest.raises(UserError, match=r"^a: permission denied; choose another folder"), os_faults("a"):
        raise PermissionError(13, "no")
