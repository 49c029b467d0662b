"""Place recognition: which frame of a reference traverse shows the place of each frame of a query traverse.

One method a file, all from features to `Matches`; `methods` is the table of them. Features are rows here, (n, m) of the
references and (q, m) of the queries, where the rest of the library has a frame a column.
"""

from smal.place_recognition.matches import Matches
from smal.place_recognition.methods import METHODS, MatchSettings
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from smal.place_recognition.seqslam import SeqSlamSettings, match_seqslam
from smal.place_recognition.traverse_matching import match_traverses

__all__ = [
    "METHODS",
    "MatchSettings",
    "Matches",
    "SeqSlamSettings",
    "match_nearest_sequence",
    "match_seqslam",
    "match_traverses",
]
