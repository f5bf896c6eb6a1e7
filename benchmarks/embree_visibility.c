/* Transmittance of Gaussians along rays on Embree 4: user geometry, every hit in any order, early stop.
 *
 * The comparator of tracing.py. One primitive a Gaussian, bounded by its own box; the occlusion callback evaluates the
 * analytic response (shift to the closest point, then the cross-product form), multiplies the transmittance and ends
 * the traversal by "occluded" once that falls below the stop. One ray a call of rtcOccluded1, one thread.
 *
 * Compiled at benchmark time by tracing_baselines.py, without Embree's headers: the declarations below are the part of
 * its documented C interface (Embree 4 API reference) that is used. Its symbols come from the library loaded before.
 */
#include <math.h>
#include <stdlib.h>
#include <sys/types.h>

typedef struct RTCDeviceTy *RTCDevice;
typedef struct RTCSceneTy *RTCScene;
typedef struct RTCGeometryTy *RTCGeometry;

enum { RTC_GEOMETRY_TYPE_USER = 120 };
enum { RTC_DEVICE_PROPERTY_VERSION = 0 };

struct __attribute__((aligned(16))) RTCBounds {
    float lower_x, lower_y, lower_z, align0;
    float upper_x, upper_y, upper_z, align1;
};

struct RTCBoundsFunctionArguments {
    void *geometryUserPtr;
    unsigned int primID, timeStep;
    struct RTCBounds *bounds_o;
};

struct __attribute__((aligned(16))) RTCRay {
    float org_x, org_y, org_z, tnear;
    float dir_x, dir_y, dir_z, time;
    float tfar;
    unsigned int mask, id, flags;
};

struct RTCOccludedFunctionNArguments {
    int *valid;
    void *geometryUserPtr;
    unsigned int primID;
    void *context;
    struct RTCRay *ray; /* RTCRayN of one ray is laid out as RTCRay */
    unsigned int N, geomID;
};

struct RTCOccludedArguments {
    int flags;
    unsigned int feature_mask;
    void *context;
    void (*filter)(const void *);
    void (*occluded)(const struct RTCOccludedFunctionNArguments *);
    float minWidthDistanceFactor;
};

RTCDevice rtcNewDevice(const char *config);
void rtcReleaseDevice(RTCDevice device);
ssize_t rtcGetDeviceProperty(RTCDevice device, int property);
int rtcGetDeviceError(RTCDevice device);
RTCGeometry rtcNewGeometry(RTCDevice device, int type);
void rtcSetGeometryUserPrimitiveCount(RTCGeometry geometry, unsigned int count);
void rtcSetGeometryUserData(RTCGeometry geometry, void *data);
void rtcSetGeometryBoundsFunction(
    RTCGeometry geometry, void (*bounds)(const struct RTCBoundsFunctionArguments *), void *data);
void rtcSetGeometryOccludedFunction(
    RTCGeometry geometry, void (*occluded)(const struct RTCOccludedFunctionNArguments *));
void rtcSetGeometryBuildQuality(RTCGeometry geometry, int quality);
void rtcCommitGeometry(RTCGeometry geometry);
void rtcReleaseGeometry(RTCGeometry geometry);
RTCScene rtcNewScene(RTCDevice device);
unsigned int rtcAttachGeometry(RTCScene scene, RTCGeometry geometry);
void rtcSetSceneBuildQuality(RTCScene scene, int quality);
void rtcCommitScene(RTCScene scene);
void rtcReleaseScene(RTCScene scene);
void rtcOccluded1(RTCScene scene, struct RTCRay *ray, struct RTCOccludedArguments *arguments);

static const float ALPHA_MAX = 0.99f;
static const float ALPHA_MIN = 1.0f / 255.0f;

/* One row of PackedGaussians.rows. */
struct Gaussian {
    float center[3], opacity;
    float whitening_0[3], radius_squared;
    float whitening_1[3], unused_1;
    float whitening_2[3], unused_2;
};

/* What a ray carries; Embree's context comes first and holds instance stacks, of one or two words by version. */
struct Query {
    unsigned int embree[4];
    const struct Gaussian *gaussians;
    float transmittance, stop;
};

struct Comparator {
    RTCDevice device;
    RTCScene scene;
    const struct Gaussian *gaussians;
    const float (*bounds)[6];
};

static float dot(const float a[3], const float b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void bound_gaussian(const struct RTCBoundsFunctionArguments *arguments) {
    const float *box = ((const struct Comparator *)arguments->geometryUserPtr)->bounds[arguments->primID];
    struct RTCBounds *out = arguments->bounds_o;
    out->lower_x = box[0], out->lower_y = box[1], out->lower_z = box[2];
    out->upper_x = box[3], out->upper_y = box[4], out->upper_z = box[5];
}

static void multiply_transmittance(const struct RTCOccludedFunctionNArguments *arguments) {
    if (!arguments->valid[0]) return;
    struct RTCRay *ray = arguments->ray;
    struct Query *query = arguments->context;
    const struct Gaussian *g = query->gaussians + arguments->primID;
    const float direction[3] = {ray->dir_x, ray->dir_y, ray->dir_z};
    float p[3] = {ray->org_x - g->center[0], ray->org_y - g->center[1], ray->org_z - g->center[2]};
    const float t_closest = -dot(p, direction);
    for (int k = 0; k < 3; k++) p[k] += direction[k] * t_closest;
    const float q[3] = {dot(g->whitening_0, p), dot(g->whitening_1, p), dot(g->whitening_2, p)};
    const float d[3] = {
        dot(g->whitening_0, direction), dot(g->whitening_1, direction), dot(g->whitening_2, direction)};
    const float c[3] = {q[1] * d[2] - q[2] * d[1], q[2] * d[0] - q[0] * d[2], q[0] * d[1] - q[1] * d[0]};
    const float dd = dot(d, d), cc = dot(c, c);
    if (!(cc < g->radius_squared * dd)) return;
    if (!(t_closest - dot(q, d) / dd > 0.0f)) return;
    const float alpha = fminf(ALPHA_MAX, g->opacity * expf(-0.5f * cc / dd));
    if (!(alpha >= ALPHA_MIN)) return;
    query->transmittance *= 1.0f - alpha;
    if (query->transmittance < query->stop) ray->tfar = -INFINITY;
}

void comparator_free(struct Comparator *comparator) {
    rtcReleaseScene(comparator->scene);
    rtcReleaseDevice(comparator->device);
    free(comparator);
}

/* Build over `count` Gaussians and boxes (lower, upper), which the caller keeps alive; NULL if Embree fails. */
struct Comparator *comparator_new(
    const struct Gaussian *gaussians, const float (*bounds)[6], unsigned int count, int quality) {
    struct Comparator *comparator = calloc(1, sizeof *comparator);
    if (!comparator) return NULL;
    comparator->gaussians = gaussians;
    comparator->bounds = bounds;
    comparator->device = rtcNewDevice("threads=1");
    comparator->scene = rtcNewScene(comparator->device);
    rtcSetSceneBuildQuality(comparator->scene, quality);
    RTCGeometry geometry = rtcNewGeometry(comparator->device, RTC_GEOMETRY_TYPE_USER);
    rtcSetGeometryUserPrimitiveCount(geometry, count);
    rtcSetGeometryBuildQuality(geometry, quality);
    rtcSetGeometryUserData(geometry, comparator);
    rtcSetGeometryBoundsFunction(geometry, bound_gaussian, NULL);
    rtcSetGeometryOccludedFunction(geometry, multiply_transmittance);
    rtcCommitGeometry(geometry);
    rtcAttachGeometry(comparator->scene, geometry);
    rtcCommitScene(comparator->scene);
    rtcReleaseGeometry(geometry); /* the scene holds it */
    if (rtcGetDeviceError(comparator->device) != 0) {
        comparator_free(comparator);
        return NULL;
    }
    return comparator;
}

long comparator_version(struct Comparator *comparator) {
    return (long)rtcGetDeviceProperty(comparator->device, RTC_DEVICE_PROPERTY_VERSION);
}

void comparator_trace(
    struct Comparator *comparator,
    const float (*origins)[3],
    const float (*directions)[3],
    size_t count,
    float stop,
    float *out_transmittance) {
    for (size_t i = 0; i < count; i++) {
        struct Query query = {{~0u, ~0u, ~0u, ~0u}, comparator->gaussians, 1.0f, stop};
        struct RTCOccludedArguments arguments = {.feature_mask = ~0u, .context = &query};
        struct RTCRay ray = {
            origins[i][0], origins[i][1], origins[i][2], 0.0f,
            directions[i][0], directions[i][1], directions[i][2], 0.0f,
            INFINITY, ~0u, 0, 0};
        rtcOccluded1(comparator->scene, &ray, &arguments);
        out_transmittance[i] = query.transmittance;
    }
}
