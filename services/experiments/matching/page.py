"""Page on which a person judges matches, the least certain first, and saves a truth file."""

from typing import Final

import numpy as np

from schemas.codec import printable
from services.experiments import html
from services.experiments.matching.report import Result, title_of
from smal.arrays import evenly

_MATCHES: Final = 200  # Maximum number of matches on a page.
_REFERENCES: Final = 60  # Maximum number of references on a page.


def judging_page(result: Result) -> str:
    """Return the page of some matches."""
    matches = result.matches
    names = [printable(name, 255) for name in result.references.source.frames]
    # A probability of a half is the least certain; other scores only rank the matches.
    doubt = np.abs(matches.score - 0.5) if result.probable else matches.score
    order = np.argsort(doubt, kind="stable")
    shown = order[matches.matched[order]][:_MATCHES].tolist()
    spread = evenly(len(names), _REFERENCES).tolist()
    found = matches.reference[shown].tolist()
    asked = result.queries.source.images(shown)
    known = result.references.source.images([*found, *spread])
    cards = [
        {
            "query": query,
            "reference": reference,
            "score": matches.score[query],
            "photos": {
                f"query {query}: {printable(result.queries.source.frames[query], 255)}": asked[
                    query
                ],
                f"reference {reference}: {names[reference]}": known[reference],
            },
        }
        for query, reference in zip(shown, found, strict=True)
    ]
    return html.render(
        "match.html",
        chosen=title_of(result),
        matched=int(matches.matched.sum()),
        cards=cards,
        references={f"reference {number}": known[number] for number in spread if number in known},
        tolerance=result.settings.tolerance or 0,
        last=len(names) - 1,
    )
