from prefect import flow

@flow(name="feed-batch")
def feed_batch(n: int = 3) -> int:
    """Feed."""
    return n
