"""The program of a Blender process: requests in, answers out.

`process.py` starts it by its path. It loads `stage.py` by its path too, so that Blender's process
does not hold the rest of the package. It reads pickled requests from its standard input and writes
answers to what was its standard output; what Blender prints goes to standard error.
"""

import os
import pickle
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path


def main() -> None:
    """Answer requests until the standard input ends."""
    answers = os.fdopen(os.dup(1), "wb")
    requests = os.fdopen(os.dup(0), "rb")
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    spec = spec_from_file_location("stereogenbench_stage", Path(__file__).with_name("stage.py"))
    assert spec is not None
    assert spec.loader is not None
    stage = module_from_spec(spec)
    spec.loader.exec_module(stage)
    server = stage.Server()
    while True:
        try:
            call, arrays = pickle.load(requests)
        except EOFError:
            break
        try:
            answer = server.answer(call, arrays)
        except stage.AssetError as error:
            answer = {"error": str(error)}, []
        pickle.dump(answer, answers, protocol=5)
        answers.flush()
    os._exit(0)  # Blender's own clean-up takes long and may crash.


if __name__ == "__main__":
    main()
