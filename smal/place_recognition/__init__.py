"""Place recognition: which frame of a reference traverse shows the place of each frame of a query traverse.

One method a file, all from features to `Matches`; `methods` is the table of them. Features are rows here, (n, m) of the
references and (q, m) of the queries, where the rest of the library has a frame a column.
"""

from smal.place_recognition.matches import Matches

__all__ = ["Matches"]
