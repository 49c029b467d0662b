"""Place recognition: which frame of a reference traverse shows the place of each frame of a query traverse.

One method a file, each from features to `Matches`; `methods` lists them. Features are rows here, (n, m) of the
references and (q, m) of the queries; in the rest of the library a frame is a column.
"""

from smal.place_recognition.matches import Matches

__all__ = ["Matches"]
