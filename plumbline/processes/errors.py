"""The base class of the project's public exceptions."""


class PlumblineError(Exception):
    """Base of every error that Plumbline raises on purpose; its message is a sentence for the user."""
