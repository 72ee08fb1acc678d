"""Position to features (see `invgraphics.core.Encoding`); each entry is a frozen config with ``build()``."""

ENCODINGS = {
    "frequency": "invgraphics.fields.encodings.frequency:FrequencyConfig",
    "hash": "invgraphics.fields.encodings.hash:HashConfig",
}
