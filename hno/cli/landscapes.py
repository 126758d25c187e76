"""The landscape of a model: a file beside results.json that the page loads."""

from __future__ import annotations

import logging
import time

from hno.cli.results import Results
from hno.data.store import replace_whole
from hno.evaluation.film import frames
from hno.evaluation.landscape import landscape
from hno.evaluation.page_script import LANDSCAPE, script
from hno.evaluation.sections import Evaluation

log = logging.getLogger(__name__)


def write_landscape(evaluation: Evaluation, results: Results, number: int = 0) -> dict[str, str]:
    """Write the landscape of a model, if it is asked for.

    Args:
        evaluation: the model.
        results: of the run; the file lies beside them.
        number: of the model among those that are evaluated.

    Returns:
        The name of the file as an entry of results.json; nothing if there is none, which costs no run its results.
    """
    options, began = evaluation.options, time.perf_counter()
    if not (options["landscape"] or options["landscape_truth"]):
        return {}
    try:
        content = landscape(evaluation.policy, options["landscape_truth"], evaluation.equilibria)
        content["film"] = frames(results.path.parent)
        text = script(content)
    except ValueError as error:
        log.warning("There is no landscape: %s", error)
        return {}
    name = LANDSCAPE.format(number or "")
    replace_whole(results.path.parent / name, lambda draft: draft.write_text(text, encoding="utf-8"))
    results.time("landscape", time.perf_counter() - began)
    return {"landscape": name}
