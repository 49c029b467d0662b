"""Place recognition: which frame of a reference traverse shows the place of each frame of a query traverse.

One method a file, all from features to `Matches`; `methods` is the table of them.
"""

from smal.place_recognition.matches import Matches

__all__ = ["Matches"]
