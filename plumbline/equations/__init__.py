"""The equations of motion of every mechanism, once, in several kinds of numbers.

`tree.Tree` evaluates them over an `Arithmetic` (`arithmetic`): doubles or long doubles in a batch, balls
(`balls`), jets (`jets`), expressions of heyoka and numbers of mpmath (`objects`).  Nothing here asks whether
a mechanism is a chain or a tree.
"""
