"""Calls of tasks in this process."""

from plumbline.processes import workers
from plumbline.processes.workers import Executor, Limits


class InProcessWorkers(Executor):
    """Stands for the pool of workers: the same calls in this process, so that hundreds of runs are quick."""

    capacity = 1

    def __init__(self, jobs, limits=None):
        self.limits = limits or Limits()

    def start(self, task):
        self.task = task

    def collect(self):
        return [(self.task, workers.run_task(self.task))]
