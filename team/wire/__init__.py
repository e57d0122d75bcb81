"""The wire: channels, messages, codec and buses. It does not know what a map is."""
