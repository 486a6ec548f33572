"""Plain float64 twins of the neighbour kernels in kernels/build: slow, obvious, and the specification."""

import numpy as np

TIE = 1.00001


def hilbert(points, low, cells, bits):
    """Curve index of every point: Skilling, "Programming the Hilbert curve", one point and one bit at a time."""
    codes = []
    for point in np.clip((points - low) * cells, 0, 2**bits - 1).astype(int):
        x = list(map(int, point))
        q = 1 << (bits - 1)
        while q > 1:
            p = q - 1
            for i in range(3):
                if x[i] & q:
                    x[0] ^= p
                else:
                    t = (x[0] ^ x[i]) & p
                    x[0] ^= t
                    x[i] ^= t
            q >>= 1
        x[1] ^= x[0]
        x[2] ^= x[1]
        t, q = 0, 1 << (bits - 1)
        while q > 1:
            if x[2] & q:
                t ^= q - 1
            q >>= 1
        code = 0
        for bit in range(bits - 1, -1, -1):
            for i in range(3):
                code = code << 1 | ((x[i] ^ t) >> bit & 1)
        codes.append(code)
    return np.array(codes)


def knn_leaves(points, order, unit):
    """Leaves (l, 3, 16), missing points at infinity, and their boxes (l, 2, 3)."""
    count = -(-len(points) // 16)
    leaves = np.full((count, 3, 16), np.inf)
    boxes = np.empty((count, 2, 3))
    for leaf in range(count):
        inside = points[order[16 * leaf:16 * leaf + 16]] / unit
        leaves[leaf, :, :len(inside)] = inside.T
        boxes[leaf] = inside.min(axis=0), inside.max(axis=0)
    return leaves, boxes


def knn_nodes(boxes):
    """Boxes of the level above: the union of every 16."""
    groups = [boxes[i:i + 16] for i in range(0, len(boxes), 16)]
    return np.array([(group[:, 0].min(axis=0), group[:, 1].max(axis=0)) for group in groups])


def knn_indices(points, queries, k):
    """Indices and distances of the k nearest points of every query; -1 and infinity for none."""
    indices, distances = np.full((len(queries), k), -1), np.full((len(queries), k), np.inf)
    for i, query in enumerate(np.asarray(queries, float)):
        distance = np.linalg.norm(np.asarray(points, float) - query, axis=1)
        near = np.argsort(distance, kind="stable")[:k]
        indices[i, :len(near)], distances[i, :len(near)] = near, distance[near]
    return indices, distances


def knn_covariance(points, queries, k):
    """Eigenvalues (ascending), normals and k-th distances: of all points up to the k-th distance, ties included."""
    points = np.asarray(points, float)
    eigenvalues, normals, reach = [], [], []
    for query in np.asarray(queries, float):
        distance = ((points - query) ** 2).sum(axis=1)
        kth = np.sort(distance)[min(k, len(points)) - 1] if len(points) >= k else np.inf
        near = points[distance <= kth * TIE]
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True) if len(near) > 1 else np.zeros((3, 3)))
        eigenvalues.append(values)
        normals.append(vectors[:, 0])
        reach.append(np.sqrt(kth))
    return np.array(eigenvalues), np.array(normals), np.array(reach)
