"""The networks, in torch: encoders of layouts and of panoramas, and the decoder of latents.

Begin with `layout_encoder.py` and `image_encoder.py`, the two that ship; the latter stands on a trunk that was
pretrained on photographs (`trunk.py`). `ring_image_encoder.py` is an image encoder without a trunk,
`paper_encoders.py` has the encoders of the paper; `horizon_attention.py` is the attention around the horizon that image
encoders share, `image_features.py` what they say of a panorama, `decoder.py` draws the layout of a latent. `loading.py`
rebuilds networks from a bundle; `lalaloc_core.localise.encoders` runs the exported ones without torch.
"""

from lalaloc_core.nets.decoder import LayoutDecoder
from lalaloc_core.nets.image_encoder import TrunkImageEncoder
from lalaloc_core.nets.loading import LayoutEncoder, load_decoder, load_layout_encoder
from lalaloc_core.nets.paper_encoders import PaperImageEncoder
from lalaloc_core.nets.ring_image_encoder import RingImageEncoder

ImageEncoder = RingImageEncoder | TrunkImageEncoder | PaperImageEncoder

__all__ = ["ImageEncoder", "LayoutDecoder", "LayoutEncoder", "load_decoder", "load_layout_encoder"]
