"""Answers: what every door to the model gives, and how it is composed of what was found.

Begin with `documents.py`, the answers, and `views.py`, their part about the photograph. `compose.py` makes those of a
search and of a moving camera, `turns.py` searches and answers for photographs of one spot, and `pinned.py` has albums.
The service adds the ids of stored plans; fields that both have, with their descriptions, stand here only.
"""
