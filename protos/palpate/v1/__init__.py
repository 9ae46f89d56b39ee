"""The wire contract: .proto files and the Python that `make proto` generates from them."""
