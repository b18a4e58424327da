"""The networks, in torch: encoders of layouts and of panoramas, and the decoder of latents.

Begin with `trunk_encoder.py`, the image encoder that ships, on a trunk that was pretrained on photographs (`trunk.py`).
`ring.py` has the layout encoder that ships and an image encoder without a trunk, `resnet.py` the encoders of the paper;
`mixer.py` is the attention around the horizon that the first two share, `decoder.py` draws the layout of a latent.
`loading.py` rebuilds networks from a bundle; `lalaloc_core.localise.encoders` runs the exported ones without torch.
"""

from lalaloc_core.nets.decoder import LayoutDecoder
from lalaloc_core.nets.loading import LayoutEncoder, load_decoder, load_layout_encoder
from lalaloc_core.nets.resnet import PaperImageEncoder
from lalaloc_core.nets.ring import RingImageEncoder
from lalaloc_core.nets.trunk_encoder import TrunkImageEncoder

ImageEncoder = RingImageEncoder | TrunkImageEncoder | PaperImageEncoder

__all__ = ["ImageEncoder", "LayoutDecoder", "LayoutEncoder", "load_decoder", "load_layout_encoder"]
