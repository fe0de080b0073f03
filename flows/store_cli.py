"""`ahoy store`: look at a store, repair it, collect what nothing needs, bring it to the current schemas."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.duration import seconds_of

if TYPE_CHECKING:
    from storage_schema.collect import Orphan
    from storage_schema.store import ArtifactStore
    from storage_schema.survey import Finding

app = typer.Typer(no_args_is_help=True, help="The artifact store: check, collect garbage, migrate.")
console = Console()

EXIT_BAD_INPUT = 2
EXIT_DAMAGED = 4
_SHOWN = 20

Url = Annotated[str, typer.Argument(help="folder or URL of the store")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]


@app.command()
def check(
    store: Url,
    repair: Annotated[bool, typer.Option("--repair", help="move what is damaged out of the way")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="compare sizes only, not hashes")] = False,
    as_json: AsJson = False,
) -> None:
    """Look at everything; exit status 4 if something is damaged (or still is, after --repair)."""
    from storage_schema.repair import repair as repair_all
    from storage_schema.survey import survey

    with _telling() as tell:
        found = survey(_open(store), verify=not quick, progress=tell)
        left = repair_all(_open(store), found.findings) if repair else found.findings
    if as_json:
        print(json.dumps({**found.to_json(), "left": len(left)}))
    else:
        counts = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in found.counts.items())
        console.print(counts, soft_wrap=True, highlight=False)
        _show_findings(found.findings)
        _show_orphans(found.orphans, "can go after a day: `ahoy store gc`")
        if repair and found.findings:
            console.print(f"repaired {len(found.findings) - len(left)} of {len(found.findings)}")
    if left:
        raise typer.Exit(EXIT_DAMAGED)


@app.command()
def gc(
    store: Url,
    older_than: Annotated[str, typer.Option(help="only what was written longer ago, such as 90m, 36h or 7d")] = "1d",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only say what would be deleted")] = False,
    as_json: AsJson = False,
) -> None:
    """Delete what killed attempts, repairs and merges left; give it more time than the longest stage takes."""
    from storage_schema.collect import collect

    age_s = _age(older_than)
    with _telling():
        found = collect(_open(store), age_s, dry_run=dry_run)
    if as_json:
        print(json.dumps({"dry_run": dry_run, "deleted": [orphan.__dict__ for orphan in found]}))
    else:
        _show_orphans(found, "would be deleted" if dry_run else "deleted")
        console.print(f"{len(found)} in all")


@app.command()
def migrate(
    store: Url,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only count what is older")] = False,
    as_json: AsJson = False,
) -> None:
    """Upgrade what older versions wrote, in place; may be interrupted and started again, while runs go on."""
    from storage_schema.migrate import migrate as migrate_all

    with _telling() as tell:
        counts = migrate_all(_open(store), dry_run=dry_run, progress=tell)
    if as_json:
        print(json.dumps({"dry_run": dry_run, **counts}))
    else:
        verb = "older than this version" if dry_run else "upgraded"
        console.print(f"{verb}: " + ", ".join(f"{count} {name}" for name, count in counts.items()))


def _open(url: str) -> ArtifactStore:
    from storage_schema.store import ArtifactStore

    return ArtifactStore(url)


@contextmanager
def _telling() -> Iterator[Callable[[str], None]]:
    """A line that says what is looked at, where somebody watches; errors of the store as words and an exit status."""
    from storage_schema.errors import StoreError
    from storage_schema.secrets import redact

    try:
        with console.status("looking") as status:
            yield lambda what: status.update(escape(what))
    except (StoreError, ValueError, OSError) as error:
        console.print("[red]error:[/]", escape(redact(str(error))), highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None


def _age(text: str) -> float:
    try:
        return seconds_of(text, "36h")
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--older-than") from None


def _show_findings(findings: tuple[Finding, ...]) -> None:
    if not findings:
        console.print("nothing is damaged")
        return
    table = Table("kind", "path", "problem", "remedy")
    for finding in findings[:_SHOWN]:
        table.add_row(finding.kind, escape(finding.path), escape(finding.problem), escape(finding.remedy))
    console.print(table)
    kinds = Counter(finding.kind for finding in findings)
    console.print("damaged: " + ", ".join(f"{count} {kind}" for kind, count in kinds.most_common()))


def _show_orphans(orphans: tuple[Orphan, ...] | list[Orphan], what: str) -> None:
    for kind, count in Counter(orphan.kind for orphan in orphans).most_common():
        size = sum(orphan.bytes for orphan in orphans if orphan.kind == kind)
        console.print(f"{kind}: {count} ({size / 2**20:.1f} MB) {what}", highlight=False)
