"""VGGT (Visual Geometry Grounded Transformer) for inference, from the official checkpoint.

An implementation of our own. Read it from the outside in: model.py (the geometry model),
network.py (its steps), aggregator.py, camera_head.py, depth_head.py, layers.py. Point and track
heads are left out: points come from depth and K.

What is saved against running the whole network on every window, all of it exact:
- patch tokens are computed once per image (28 % of a 3-view inference);
- so is frame block 0, which sees one view alone, for each role: the window's first view or
  another;
- only the tokens that the depth head reads are kept, and the last global block is computed only
  for the rows that somebody reads;
- rotations, place encodings and the resampled position embedding are kept for each image size;
- the depth head runs on the views that were asked for, in channels-last order.

Memory, VGGT-1B, 518x392, windows of 5. Parameters in millions: patch embedding 304.4, aggregator
604.7, camera head 216.2, depth head 32.7; together 1157.9 of the checkpoint's 1256.5.

                                     float32 (CPU)        bfloat16 transformer, float32 heads (GPU)
    weights                          4.63 GB              1.82 + 1.00 = 2.82 GB
    tokens kept for the depth head   .17 GB               .17 GB
    working set of one inference     about .5 GB          about .6 GB
    tokens of 64 cached images       up to .82 GB         up to .82 GB (8.5 to 12.8 MB each)
    CUDA context                     -                    about .5 GB

- one node (frontend alone): about 5 GB of GPU memory; a GPU of 6 GB carries it;
- both nodes in one process (``slam``): the same and the tokens of loop closure's 32 images, up to
  .4 GB, unless they fall out of the cache that both share; one inference runs at a time;
- two processes (``frontend`` and ``loop_closure``): twice one node, about 10 GB.
The figures for the GPU are arithmetic, not measurements.
"""
