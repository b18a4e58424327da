"""Command line of the service, `lalaloc-service`.

Begin with `entry_point.py`; `tenant_commands.py`, `audit_commands.py` and `backup_commands.py` have the commands, of
the parts in `command_parts.py`.
"""

from service.cli.entry_point import add_serve_arguments, build_parser, main, serve

__all__ = ["add_serve_arguments", "build_parser", "main", "serve"]
