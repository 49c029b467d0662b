"""A page on which a person says which matches are right, the doubtful ones first, and gets a truth file of it."""

from html import escape
from typing import Final

import numpy as np

from schemas.codec import printable
from services.experiments import html
from services.experiments.matching.report import Result, title_of
from smal.likelihood import evenly

# Matches that a page shows, and references to find a right one by.
_MATCHES = 200
_REFERENCES = 60


def judging_page(result: Result) -> str:
    """Return the page of some matches."""
    matches = result.matches
    names = [printable(name, 255) for name in result.references.source.frames]
    # A probability of a half is the most doubtful one; other scores say only which matches are surer.
    doubt = np.abs(matches.score - 0.5) if result.probable else matches.score
    order = np.argsort(doubt, kind="stable")
    shown = [query for query in order.tolist() if matches.matched[query]][:_MATCHES]
    spread = evenly(len(names), _REFERENCES).tolist()
    found = matches.reference[shown].tolist()
    asked = result.queries.source.images(shown)
    known = result.references.source.images([*found, *spread])
    cards = []
    for query, reference in zip(shown, found, strict=True):
        name = printable(result.queries.source.frames[query], 255)
        pair = {
            f"query {query}: {name}": asked[query],
            f"reference {reference}: {names[reference]}": known[reference],
        }
        said = f"{html.strip(pair)}{_QUESTION.format(query=query, last=len(names) - 1)}"
        score = f"score {matches.score[query]:.3f}"
        cards.append(f'<fieldset data-query="{query}" data-reference="{reference}"><legend>{score}</legend>'
                     f"{said}</fieldset>")  # fmt: skip
    head = f"{len(shown)} of {int(matches.matched.sum())} matches, the most doubtful ones first."
    body = [
        f"<p>{escape(title_of(result))}. {head}</p>{_SAVE}",
        f'<div class="pair">{"".join(cards)}</div>',
        "<h2>References, to find the right one by</h2>",
        html.strip({f"reference {number}": known[number] for number in spread if number in known}),
        _SCRIPT.format(tolerance=result.settings.tolerance or 0, last=len(names) - 1),
    ]
    return html.page("SMAL: are these the same places?", "\n".join(body), 72)


_SAVE: Final = """<style>
.save { position: sticky; top: 0; background: var(--back); padding: .5rem 0; }
fieldset { border: 1px solid var(--line); border-radius: .5rem; min-width: 0; }
fieldset .strip { grid-template-columns: 1fr 1fr; } label { display: block; }
</style>
<p class="save"><button id="save">Save truth.csv</button>
<output id="said" aria-live="polite">Nothing judged yet.</output>
Give the file to <code>smal match --truth</code>.</p>"""
_QUESTION: Final = """<label><input type="radio" name="q{query}" value="right"> the same place</label>
<label><input type="radio" name="q{query}" value="wrong"> another place; right is reference
<input type="number" min="0" max="{last}" aria-label="right reference of query {query}"></label>
<label><input type="radio" name="q{query}" value="none"> no reference shows this place</label>"""
_SCRIPT: Final = """<script>
const tolerance = {tolerance}, last = {last};
function rows() {{
  const found = [];
  let open = 0;
  for (const card of document.querySelectorAll("fieldset")) {{
    const said = card.querySelector(":checked")?.value, query = card.dataset.query;
    const typed = card.querySelector("[type=number]").value;
    if (said === "none") found.push(`${{query}},,`);
    if (said === "wrong" && typed === "") open += 1;
    const named = said === "right" ? card.dataset.reference : said === "wrong" ? typed : "";
    const right = Math.min(last, Math.max(0, Math.round(Number(named))));
    const first = Math.max(0, right - tolerance), end = Math.min(last, right + tolerance);
    if (named !== "") found.push(`${{query}},${{first}},${{end}}`);
  }}
  const lacks = open ? ` ${{open}} wrong ones lack the right reference and are left out.` : "";
  document.getElementById("said").textContent = `${{found.length}} judged.${{lacks}}`;
  return found;
}}
document.addEventListener("input", (event) => {{
  if (event.target.type === "number") event.target.closest("label").querySelector("[type=radio]").checked = true;
  rows();
}});
document.getElementById("save").addEventListener("click", () => {{
  const text = ["query,reference_first,reference_last", ...rows(), ""].join("\\n");
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], {{type: "text/csv"}}));
  link.download = "truth.csv";
  link.click();
}});
</script>"""
