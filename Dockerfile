# splatvk from its tar.xz, with the drivers of Mesa; `tools/package image` builds it (tools/packages/image).
#   docker run --rm -v "$PWD:/work" splatvk run photos --views 4 --out scene              on the CPU
#   docker run --rm --gpus all -v "$PWD:/work" splatvk run photos --views 4 --out scene   on an NVIDIA card
#   docker run --rm --network host -v "$PWD:/work" splatvk view scene --port 8080         listens on 127.0.0.1 only
# The folder of the build holds splatvk.tar.xz.
ARG BASE=docker.io/library/debian:12-slim
FROM ${BASE}
# libegl1 and libxext6: NVIDIA's Vulkan driver, which the container toolkit brings in, loads both.
RUN apt-get update -q \
    && DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends \
        libvulkan1 mesa-vulkan-drivers libegl1 libxext6 libgcc-s1 libstdc++6 libheif1 ffmpeg \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* /var/log/*
# ADD unpacks.
ADD splatvk.tar.xz /opt/
RUN mv /opt/splatvk-* /opt/splatvk && ln -s /opt/splatvk/bin/splatvk /usr/local/bin/splatvk && splatvk doctor
# The container toolkit mounts the Vulkan driver only where `graphics` is asked for.
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility
WORKDIR /work
# For containers that stay, as those of `splatvk view`. Images in OCI's format have no such field; Docker's have.
HEALTHCHECK --interval=5m --timeout=60s CMD ["splatvk", "doctor"]
ENTRYPOINT ["splatvk"]
