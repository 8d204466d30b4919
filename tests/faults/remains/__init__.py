"""How clients and servers end, and that nothing of them remains."""
