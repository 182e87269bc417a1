"""Execution: scenarios × engines → judged rows."""
