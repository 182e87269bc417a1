"""Pages in a browser that are watched for what they must not do."""


def watch(page, path, trouble):
    """Collect what the page of a file says on the console, its errors and dialogs, and what else it loads."""
    page.on("console", lambda message: trouble.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: trouble.append(f"error: {error}"))
    page.on("dialog", lambda dialog: (trouble.append(f"dialog: {dialog.message}"), dialog.dismiss()))
    page.on("request", lambda r: None if is_own(r.url, path) else trouble.append(f"request: {r.url}"))


def is_own(url, path):
    return url.split("#")[0] == path.as_uri() or url.startswith("data:")
