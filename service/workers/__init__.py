"""The programs that run in worker processes: `decode.py` opens pictures, `convert.py` plans, `lpo.py` optimises poses.

Begin with `process.py`, the loop that all run in. `service.pools` starts such processes and watches over them; nothing
of it is loaded in them, and nothing is re-exported here, as every worker would load it.
"""
