"""Command line of the service, `lalaloc-service`.

Begin with `entry_point.py`, which serves and manages keys; `data_commands.py` has the commands about stored data,
`lan_access.py` what `serve --lan` needs, and `command_parts.py` what commands share.
"""

from service.cli.entry_point import add_serve_arguments, build_parser, main, serve
