"""How many examples a property is tried on: some in the quick suite, 2,000 in the slow one."""

from hypothesis import settings

MANY = 2000


def examples(quick: int) -> settings:
    """Settings of a property that the quick suite tries on so many examples.

    The profile "thorough" (`make test-slow`) asks for its own number, in place of the one that a test would fix.
    """
    return settings(max_examples=MANY if settings.get_current_profile_name() == "thorough" else quick)
