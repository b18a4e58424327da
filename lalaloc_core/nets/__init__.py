"""Networks in torch: layout encoders, image encoders, and the decoder of latents.

Begin with `sphere_network.py` and `layout_network.py`, those of the shipped model; `view_network.py` is for views. The
image encoders extend a trunk pretrained on photographs (`trunk.py`), predict `image_features.py`, and use attention
around the horizon. `ring_image_encoder.py` is an image encoder without a trunk, `paper_encoders.py` has the encoders of
the paper. `loading.py` rebuilds networks from a bundle. The exported networks run in `localise/encode/`, without torch.
"""

from lalaloc_core.nets.layout_network import DECODED_HEIGHT, DECODED_WIDTH, LayoutDecoder, RingConfig, RingLayoutEncoder
from lalaloc_core.nets.loading import LayoutNetwork, load_decoder, load_layout_encoder
from lalaloc_core.nets.paper_encoders import PaperConfig, PaperImageEncoder
from lalaloc_core.nets.ring_image_encoder import RingImageEncoder
from lalaloc_core.nets.sphere_network import TrunkEncoderConfig, TrunkImageEncoder
from lalaloc_core.nets.view_network import ViewEncoderConfig, ViewNetwork

ImageEncoder = RingImageEncoder | TrunkImageEncoder | PaperImageEncoder
