"""``stereogenbench browse``: a local web page to look through scenes."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.options import (
    DataOptions,
    DepthUnitOption,
    depth_of,
    grouped,
)
from stereogenbench_data.schema.text import counted


@grouped
def browse(
    source: DataOptions,
    *,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port [any that is free].")
    ] = 0,
    open_page: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the web browser.")
    ] = True,
    depth_unit_m: DepthUnitOption = None,
) -> None:
    """Look through scenes, pairs and frames in a local web page.

    It filters scenes, flips through pairs and frames, tells disparity in pixels and depth in metres
    under the cursor, and gives the Python line of what is shown. Only this machine can reach it,
    and nothing is written. Ctrl-C ends it.
    """
    from stereogenbench_data.audit.browser.catalogue import Catalogue
    from stereogenbench_data.audit.browser.server import PageServer
    from stereogenbench_data.audit.browser.service import Service
    from stereogenbench_data.audit.scene_reader import SceneReader
    from stereogenbench_data.sources.location import is_remote, shown

    index = source.open()
    shown_data = (
        shown(source.data)
        if is_remote(source.data)
        else str(Path(source.data).expanduser().resolve())
    )
    depth = depth_of(depth_unit_m)
    reader = SceneReader(index, depth=depth)
    service = Service(Catalogue(index, shown_data=shown_data, depth=depth), reader)
    with PageServer(service, port=port) as server:
        typer.echo(f"{server.url}: {counted(len(index), 'scene')} of {shown_data}; Ctrl-C ends it")
        if open_page:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        finally:
            reader.close()
