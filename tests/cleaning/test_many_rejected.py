"""A track of which a tenth of the fixes are rejected is said to have many, and how a varying noise is given."""

import pytest
from cleaned_tracks import straight

from torchfra.cleaning.outputs.summary import MANY, UNLIKELY, sentences


@pytest.mark.parametrize(("rejected", "said"), [(3, set()), (4, {MANY}), (13, {MANY}), (14, {UNLIKELY})])
def test_from_a_tenth_of_the_fixes_on_rejections_are_said_to_be_many(rejected, said):
    cleaned = straight(40, rejected=range(rejected))
    assert {MANY, UNLIKELY} & set(sentences(cleaned)) == said
