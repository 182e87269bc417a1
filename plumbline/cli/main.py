"""The command group: `python -m plumbline`."""

from __future__ import annotations

import click

from plumbline import __version__
from plumbline.cli.options import EXIT_CODES
from plumbline.cli.result_commands import history, report, reproduce
from plumbline.cli.run_commands import nightly, run
from plumbline.cli.scenario_commands import check, list_, schema
from plumbline.cli.study_commands import drift, sweep
from plumbline.scenario.errors import did_you_mean

START = """
\b
Start with:
  python -m plumbline list scenarios
  python -m plumbline run double-tumbling-balls
  python -m plumbline run                  (everything; a few minutes)
"""


class SuggestingGroup(click.Group):
    """A group of commands that suggests the nearest name for an unknown command."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the first argument names.

        Args:
            ctx: the group's context.
            args: what follows the group's own options.

        Returns:
            The command's name, the command and its arguments.

        Raises:
            UsageError: there is no such command.

        """
        if args and args[0] not in self.commands:
            hint = did_you_mean(args[0], list(self.commands)) or f"there are: {', '.join(self.commands)}"
            raise click.UsageError(f"no command {args[0]!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)


@click.group(
    cls=SuggestingGroup,
    epilog=START + EXIT_CODES,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(__version__, prog_name="plumbline", message="%(prog)s %(version)s")
@click.pass_context
def main(context: click.Context) -> None:
    """Compare multibody engines with each other and with the notes' equations on identical pendulums."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


for command in (list_, run, nightly, sweep, drift, history, report, check, schema, reproduce):
    main.add_command(command)
