"""Number of examples for a property test: chosen per test in the quick suite, 2,000 in the slow one."""

from hypothesis import settings

MANY = 2000


def examples(quick: int) -> settings:
    """Return the settings of a property test with `quick` examples in the quick suite.

    Under the profile "thorough" (`make test-slow`), the number is `MANY` instead.
    """
    return settings(max_examples=MANY if settings.get_current_profile_name() == "thorough" else quick)
