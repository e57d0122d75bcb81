# One image for every process of a team: the command says which one it is.
#
# A tag can be moved, a digest can not. For an image that is the same tomorrow, look up the tag's
# digest once (docker buildx imagetools inspect python:3.11-slim) and build by it:
#   docker build --build-arg BASE=python:3.11-slim@sha256:DIGEST .
ARG BASE=python:3.11-slim
FROM ${BASE} AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE hashes-run.txt hashes-zig.txt ./
COPY team team
COPY central central
COPY sim sim
COPY teamslam teamslam
# What is installed is known by its hash beforehand, what builds the wheel too.
# The slim image has no C++ compiler: that of the ziglang wheel builds the core, for any x86-64.
RUN sed -n '/^\(pip\|cmake\|nanobind\|ninja\|packaging\|pathspec\|scikit-build-core\)==/,/[^\\]$/p' hashes-run.txt > build.txt \
 && pip install --no-cache-dir --require-hashes --no-deps --requirement build.txt --requirement hashes-zig.txt \
 && pip wheel --no-cache-dir --no-deps --no-build-isolation --wheel-dir /dist .

FROM ${BASE}
# The log's folder and that of Matplotlib's cache belong to the user.
RUN useradd --system --uid 10001 --no-create-home teamslam \
 && install --directory --owner teamslam /logs /var/cache/teamslam
RUN --mount=type=bind,from=build,source=/dist,target=/dist \
    --mount=type=bind,source=hashes-run.txt,target=/hashes-run.txt \
    pip install --no-cache-dir --require-hashes --no-deps --requirement /hashes-run.txt \
 && pip install --no-cache-dir --no-deps /dist/*.whl
ENV PYTHONUNBUFFERED=1 \
    OPENBLAS_NUM_THREADS=1 \
    OMP_NUM_THREADS=1 \
    MPLCONFIGDIR=/var/cache/teamslam/matplotlib
USER teamslam
WORKDIR /logs
ENTRYPOINT ["teamslam"]
CMD ["--help"]
