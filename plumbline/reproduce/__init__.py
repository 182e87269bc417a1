"""Stand-alone scripts that show a disagreement to an engine's maintainers.

A stored row that disagrees enters; a Python script that needs the engine and NumPy only leaves. In between
the case is shrunk to the smallest one that still shows the disagreement (`shrink`, `measure`), written out
with a Jinja2 template of the engine (`render`, `templates`), and run once before it is stored (`write`).
"""
