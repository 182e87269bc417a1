"""The base class of the project's public exceptions, and how any exception is written in one line."""

import traceback

MAX_TEXT = 2000  # characters of a message from outside that are shown and stored


class PlumblineError(Exception):
    """Base of every error that Plumbline raises on purpose; its message is a sentence for the user."""


def one_line(text: str) -> str:
    """Write a text from outside as one printable line of at most `MAX_TEXT` characters.

    Args:
        text: any text, as of an engine's exception.

    Returns:
        The text without line breaks, escapes for what cannot be printed, and its length where it is cut.

    """
    count = len(text)
    text = " ".join(text[: 2 * MAX_TEXT].split())
    if count > MAX_TEXT:
        text = f"{text[:MAX_TEXT]} … (cut: {count:,} characters)"
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def describe_exception(error: BaseException) -> str:
    """Write an exception as one line, whatever its class does.

    Returns:
        Its message; after the class name unless the error is one of the project's own.

    """
    try:
        text = one_line(str(error)) or "no message"
    except BaseException:  # a message that cannot be made is an engine's fault, too
        text = "no readable message"
    return text if isinstance(error, PlumblineError) else f"{one_line(type(error).__name__)}: {text}"


def place_of(error: BaseException) -> str:
    """Write the class of what was raised first, and the functions that called each other up to there.

    Returns:
        The same for the same failure, whatever numbers its message has.

    """
    while error.__context__ is not None:
        error = error.__context__
    calls = dict.fromkeys(frame.f_code.co_name for frame, _ in traceback.walk_tb(error.__traceback__))
    return one_line(f"{type(error).__name__}{' in ' * bool(calls)}{' > '.join(calls)}")
