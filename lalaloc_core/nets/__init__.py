"""Networks in torch: layout encoders, image encoders, and the decoder of latents.

Begin with `image_encoder.py` and `layout_encoder.py`, the two of the shipped model. The image encoder extends a trunk
pretrained on photographs (`trunk.py`), predicts `image_features.py`, and uses the attention of `horizon_attention.py`.
`ring_image_encoder.py` is an image encoder without a trunk, `paper_encoders.py` has the encoders of the paper, and
`decoder.py` reconstructs layout depth from a latent. `loading.py` rebuilds networks from a bundle. The exported
networks run in `localise/encode/encoders.py`, without torch.
"""

from lalaloc_core.nets.decoder import LayoutDecoder
from lalaloc_core.nets.image_encoder import TrunkImageEncoder
from lalaloc_core.nets.loading import LayoutEncoder, load_decoder, load_layout_encoder
from lalaloc_core.nets.paper_encoders import PaperImageEncoder
from lalaloc_core.nets.ring_image_encoder import RingImageEncoder

ImageEncoder = RingImageEncoder | TrunkImageEncoder | PaperImageEncoder

__all__ = ["ImageEncoder", "LayoutDecoder", "LayoutEncoder", "load_decoder", "load_layout_encoder"]
