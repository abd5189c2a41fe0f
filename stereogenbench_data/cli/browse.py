"""``stereogenbench browse``: look through scenes in a local web page."""

import webbrowser
from typing import Annotated

import typer

from stereogenbench_data.cli.data import full_place
from stereogenbench_data.cli.options import DataOptions, grouped, option
from stereogenbench_data.schema.text import counted


@grouped
def browse(
    source: DataOptions,
    *,
    port: Annotated[int, option("Port; 0 is any free one.", min=0, max=65535)] = 0,
    open_page: Annotated[
        bool, option("--open/--no-open", "Open the web browser.", metavar="")
    ] = True,
) -> None:
    """Look through scenes in a local web page.

    The page filters scenes, flips through pairs and frames, shows disparity in pixels and depth in
    metres under the cursor, and gives the Python line for what is shown. Only this machine can
    reach it. Nothing is written. Ctrl-C ends it.

    Example: `stereogenbench browse shards/`
    """
    from stereogenbench_data.audit.browser.catalogue import Catalogue
    from stereogenbench_data.audit.browser.server import PageServer
    from stereogenbench_data.audit.pictures import SceneReader

    index, shown_data = source.open(), full_place(source.data)
    reader = SceneReader(index)
    catalogue = Catalogue(index, shown_data=shown_data)
    with PageServer(catalogue, reader, port=port) as server:
        typer.echo(f"{server.url}: {counted(len(index), 'scene')} of {shown_data}; Ctrl-C ends it")
        if index.is_derived:
            typer.echo(f"{shown_data}: {index.derivation}")
        if open_page:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        finally:
            reader.close()
