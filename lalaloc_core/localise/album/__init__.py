"""Albums: photographs of one visit pinned to a plan, or to the plans of a venue, by one solve for all.

Begin with `solve.py`: `solve_album` takes the places to search (`AlbumGround`), the encoder, and the photographs, and
returns an `Album` of pins (`pins.py`). The contract:

* An `AlbumPhotograph` (`entry.py`) is all that is kept of a photograph: the predictions of the encoder, time, camera,
  and at most 256 binary descriptors. `photograph_entry` makes one of a decoded picture, or of features that a client
  sent; `to_bytes` and `read_entry` store it, at most 20 kB, without pixels, EXIF positions or names of owners.
* Corrections are part of the photograph in memory and stored by the caller (`Correction.to_document`,
  `read_correction`). They are certain; a pin with one is "corrected".
* `AlbumMemory` has what is slow and does not depend on corrections: the posterior of each photograph alone, and the
  links between photographs that overlap. Pass the same object again and only new photographs are compared. It belongs
  to one ground and model; another's is dropped. `to_bytes` gives the evidence of a photograph to store (`stored`).
* Every photograph gets a pin, in the order given. The result does not depend on the order in which photographs were
  added: they are ordered by the time they were taken, or by the numbers in their names.
* `moved_pins` lists what changed between two solves, such as after a new revision of a plan.
"""
