"""Words of a private language, which terms of the field have replaced, do not come back in code and pages."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
REPLACED = {
    "way back|way_back|wayback": "backward pass",
    "hindsight": "smoothed weights, one step back",
    "settled": "one-step smoothed, or converged",
    "told_by": "argument, or posterior",
    "told apart|told from|tells? them apart": "distinguished",
    "qualities|doubts|dirty": "outlier modes, or outlier",
    "drawn anew": "restart distribution",
    "poor start|poor prior": "bad prior",
    "good start": "good prior",
    "nobody's": "unassociated",
    "nobody knew|nobody has seen": "did not exist, or was not reported",
    "comes? and goe?s?": "are initiated and deleted",
    "gives way to every": "switches to the others with equal probability",
    "nothing speaks for": "has zero likelihood",
    "speaks? against": "contradicts",
    r"of the same\.|likewise": "a sentence with a subject and a verb",
    "errors that last": "time-correlated errors",
    "outliers that last": "outliers in bursts",
    "honest": "consistent",
    "to the same bits": "with bit-equal results",
    "fullest gate": "largest number of measurements in a gate",
    "odds that sum to one": "probabilities that sum to one",
    "form of joseph": "Joseph form",
    "measured is the teacher": "learning from measurements",
    "it buys|they buy": "gain",
    "calls its neighbours": "activates its neighbours",
    "begins evenly": "starts uniformly",
    "and grow on": "and keep growing",
    "as bad as it can be|as far off as can be": "infinite, or the highest rank",
    "look around in": "interactive",
    "of what targets": "kind of targets",
    "what was taken": "the columns that were taken",
    "sums up what": "summarises",
    "that can be flown": "of possible speeds",
    "follows an acceleration": "adapts to an estimated acceleration",
    "a matrix that is none|names that are none": "not positive semidefinite, or unknown names",
    "the function of that name": "its name",
    "whether this goes with": "checks that this fits",
    "among which that is": "number of runs from which it is taken",
    "the way that its size|what both ways": "by the method for its size",
    "one thing that stays|no cloud of": "one kernel",
    "one word sets": "the argument sets",
    "what is known need not": "known values",
    r"goes_on|most_memory|picture_form\b|of_plain_too": "stays_active, peak_memory, picture_format",
    "number of states": "state dimension",
    "names out of|sensors out of|columns out of": "some of",
    "goes with [a-z]": "expected beside, or fits",
    "divides? the measurement noise": "divide the noise covariance",
    "mean durations?|mean seconds": "mean sojourn time",
    "no measurement shows": "unobservable",
    r"info\.regimes|stay=|spectral=": "info.probabilities, self_transition=, continuous=",
    "runs? lost|no run is lost": "diverged",
}
"""Regular expressions of words in lower case, and the terms that stand for them."""


def texts():
    """The code and pages of the project in one line each, by path."""
    folders = (ROOT / folder for folder in ("torchfra", "scripts", "train", ".github"))
    found = [path for folder in folders for kind in ("*.py", "*.md") for path in sorted(folder.rglob(kind))]
    built = [ROOT / "scripts/docs/gallery" / folder for folder in ("examples", "pictures")]
    found = [path for path in found if not any(folder in path.parents for folder in built)]
    return {
        path.relative_to(ROOT): " ".join(path.read_text(encoding="utf-8").lower().split())
        for path in [ROOT / "README.md", *found]
    }


def replaced_words(text):
    """The replaced words of a text, each with its term."""
    found = re.findall(rf"\b(?:{'|'.join(REPLACED)})", text)  # in one pass, which is several times faster
    return [f"{word!r}: take {term!r}" for word in found for words, term in REPLACED.items() if re.match(words, word)]


def test_replaced_words_do_not_come_back():
    assert [f"{path}: {word}" for path, text in texts().items() for word in replaced_words(text)] == []


def test_a_replaced_word_is_seen_with_its_term():
    assert replaced_words("the filter of hindsight") == ["'hindsight': take 'smoothed weights, one step back'"]
