"""``stereogenbench browse``: a local web page to look through scenes."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.opening import open_data
from stereogenbench_data.cli.options import DataArgument, DepthUnitOption, RootOption
from stereogenbench_data.schema.text import counted


def browse(
    data: DataArgument,
    *,
    data_root: RootOption = None,
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
    from stereogenbench_data.schema.records import DepthEncoding
    from stereogenbench_data.sources.location import is_remote, shown

    index = open_data(data, root=data_root)
    shown_data = shown(data) if is_remote(data) else str(Path(data).expanduser().resolve())
    depth = None if depth_unit_m is None else DepthEncoding(unit_m=depth_unit_m)
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
