"""Tasks that run in this process."""

from plumbline.processes.worker_pool import Executor, Limits, Outcome, Task


class Immediate(Executor):
    """Runs each task at once; of two that were started the last one finishes first."""

    capacity = 2

    def __init__(self) -> None:
        """Start with no task."""
        self.limits = Limits()
        self.started: list[object] = []
        self.pending: list[Task] = []

    def start(self, task: Task) -> None:
        """Keep a task."""
        self.started.append(task.key)
        self.pending.append(task)
        assert len(self.pending) <= self.capacity

    def collect(self) -> list[tuple[Task, Outcome]]:
        """Run the last task that was started."""
        task = self.pending.pop()
        return [(task, Outcome(task.key, task.function(*task.arguments)))]
