"""What committed results say of each claim, into experiments/README.md: python -m experiments.studies.findings"""

from __future__ import annotations

import json
import pathlib
import sys

from experiments.studies import effects, report, tables

FOLDER = pathlib.Path(__file__).parents[1]
BEGIN, END = "<!-- findings: made by python -m experiments.studies.findings -->", "<!-- end of findings -->"


def text(folder: pathlib.Path = FOLDER) -> str:
    """The findings of all studies as Markdown."""
    parts = []
    for study in tables.STUDIES.values():
        path = folder / study.name / report.RESULTS
        parts.append(f"### {study.name}: {study.figure}")
        runs = {}
        if path.is_file():
            results = json.loads(path.read_text(encoding="utf-8"))
            runs = report.complete(results)
            count = lambda runs, memory: sum(len(seeds) for label, seeds in runs.items() if ("+" in label) == memory)
            parts.append(f"{count(runs, False)} of {count(results['runs'], False)} runs without memory, "
                         f"{count(runs, True)} with it; "
                         f"[report]({study.name}/{report.REPORT}), commit {results['commit']}.")
        rows = [row for suffix in ("", "+memory") for row in (
            {**row, "claim": row["claim"] + (", with memory" if suffix else "")}
            for row in effects.of_claims(study, runs, suffix))]
        parts.append(report.markdown_table(report.claims(rows)) if rows else
                     "No result yet. The paper says: " + "; ".join(claim.text for claim in study.claims) + ".")
    return "\n\n".join(parts)


def main(path: pathlib.Path = FOLDER / "README.md") -> None:
    """Replaces what stands between the two marks."""
    before, _, rest = path.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    path.write_text(f"{before}{BEGIN}\n\n{text(path.parent)}\n\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
