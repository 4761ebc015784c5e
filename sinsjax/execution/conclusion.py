"""The last tasks of a study whose runs have companions, which conclude from all of them."""

from collections.abc import Callable

import pyarrow as pa
import pyarrow.compute as pc

from sinsjax.execution import controlled
from sinsjax.execution.tasks import Task, TaskResult, TaskRunner


class Conclusion:
    """What concludes a study whose runs have companions."""

    def __init__(self, runner: TaskRunner, summary: Callable[[list[str]], pa.Table]) -> None:
        """Take the runs of a study.

        Args:
            runner: of the study.
            summary: some columns of the summary, all rows in any order.
        """
        self._runner, self._study = runner, runner.job.study
        self._runs = summary(controlled.needed(self._study))

    def asked(self, task: Task) -> Task:
        """A concluding task with as many rounds of sampled errors as its runs need."""
        return task._replace(rounds=controlled.rounds(self._study, self._of(task)))

    def of(self, result: TaskResult) -> TaskResult:
        """The result of a concluding task, which knows no runs, with their statistics."""
        table = result.tables["estimates"]
        made = controlled.concluded(self._study, table, self._of(result.task))
        return result._replace(tables={"estimates": made})

    def _of(self, task: Task) -> pa.Table:
        """The runs of the variants of a task."""
        variants = pa.array(self._runner.variants(task))
        return self._runs.filter(pc.is_in(self._runs["variant_id"], variants))
