"""The wire: channels, messages, codec and buses, independent of the estimation."""
