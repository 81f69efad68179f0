"""flowrect: online rectification of wide-baseline stereo, trained on what simgen renders."""
