"""Connections to Dask schedulers, for builds and frames on many machines."""

from .errors import InputError


def connect(scheduler):
    """Return a client of a scheduler, and what to close afterwards.

    Parameters
    ----------
    scheduler : str or distributed.Client
        An address such as "tcp://host:8786", "local" for processes of this machine, or a client.

    Raises
    ------
    InputError
        No such scheduler, or Dask is not installed.
    """
    try:
        import distributed
    except ImportError:
        raise InputError("scheduler: needs Dask: pip install clsurf[scale]") from None
    if isinstance(scheduler, distributed.Client):
        return scheduler, ()
    try:
        if scheduler == "local":
            cluster = distributed.LocalCluster(threads_per_worker=1, dashboard_address=None)
            client = distributed.Client(cluster)
            return client, (client, cluster)
        client = distributed.Client(scheduler, timeout=10)
        return client, (client,)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"scheduler {scheduler!r}: expected an address such as tcp://host:8786, or local: "
                         f"{error}") from None
