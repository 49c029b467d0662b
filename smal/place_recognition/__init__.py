"""Place recognition: which frame of a reference traverse shows the place of each frame of a query traverse.

One method a file, each from features to `Matches`; `methods` lists them. Features are rows, (n, m) of the
references and (q, m) of the queries, as everywhere but in X and Y of `smal.paper`.
"""

from smal.place_recognition.matches import Matches

__all__ = ["Matches"]
