"""The equations of motion of every mechanism, once, in several kinds of numbers.

`tree.Tree` evaluates them over an `Arithmetic` (`arithmetic`): doubles or long doubles in a batch, balls,
expressions of heyoka, numbers of mpmath, and jets (`jets`).  Nothing here asks whether a mechanism is a chain
or a tree.
"""
