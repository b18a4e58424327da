"""Settings of the service, read once from environment variables that start with `LALALOC_`.

Begin with `settings.py`; `setting_groups.py` defines them in groups, of the types in `setting_types.py`.
"""

from service.settings.settings import CONSTANTS, PREFIX, SETTING_NAMES, Settings, settings_table, work_factor
