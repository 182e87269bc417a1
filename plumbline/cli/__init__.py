"""The command line: what a user types enters, tables, files and an exit code leave.

`main` is the command group; `run_commands`, `study_commands`, `result_commands` and `scenario_commands` hold
the commands by what they are about, `options` the options they share and the checks of what was typed,
`terminal_output` what they print, `nightly` the steps of a night.
"""
