/* What visod publishes, as C has it: the payloads of three iceoryx2 publish-subscribe services, each with
 * an event service of the same name beside it.
 *
 * | service          | payload                 | type name by which iceoryx2 knows it |
 * |------------------|-------------------------|--------------------------------------|
 * | visod/odometry   | visod_odometry_message  | visod::OdometryMessage.1             |
 * | visod/features   | visod_features_message  | visod::FeaturesMessage.1             |
 * | visod/health     | visod_health_message    | visod::HealthMessage.1               |
 *
 * Little-endian, aligned to 8, without padding; the number before each field's meaning is its offset, bytes.
 * Transforms map a point from the second frame named into the first; quaternions are x, y, z, w of unit
 * length with w >= 0. Covariances are ordered x, y, z, rx, ry, rz (m^2, m rad, rad^2). Look at magic, version
 * and size before anything else. A test holds this file against the crate's own layouts. C11 or C++11.
 */
#ifndef VISOD_H
#define VISOD_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#define VISOD_ASSERT(condition, text) static_assert(condition, text)
#else
#define VISOD_ASSERT(condition, text) _Static_assert(condition, text)
#endif

#define VISOD_ODOMETRY_SERVICE "visod/odometry"
#define VISOD_ODOMETRY_TYPE "visod::OdometryMessage.1"
#define VISOD_ODOMETRY_MAGIC UINT32_C(0x444F4956)
#define VISOD_ODOMETRY_VERSION UINT32_C(1)

#define VISOD_FEATURES_SERVICE "visod/features"
#define VISOD_FEATURES_TYPE "visod::FeaturesMessage.1"
#define VISOD_FEATURES_MAGIC UINT32_C(0x464F4956)
#define VISOD_FEATURES_VERSION UINT32_C(1)
#define VISOD_MAX_FEATURES 512

#define VISOD_HEALTH_SERVICE "visod/health"
#define VISOD_HEALTH_TYPE "visod::HealthMessage.1"
#define VISOD_HEALTH_MAGIC UINT32_C(0x484F4956)
#define VISOD_HEALTH_VERSION UINT32_C(1)

/* Whoever opens a service first creates it, so that all must ask for the same sizes. */
#define VISOD_ODOMETRY_BUFFER 512
#define VISOD_FEATURES_BUFFER 8
#define VISOD_HEALTH_BUFFER 16
#define VISOD_MAX_SUBSCRIBERS 16
#define VISOD_MAX_PUBLISHERS 4
#define VISOD_MAX_NODES 40
#define VISOD_HISTORY 1

/* Numbers of the events. */
enum visod_event {
    VISOD_EVENT_PUBLISHED = 0, /* a message was published */
    VISOD_EVENT_LEAVING = 1,   /* the publisher will leave: connect to what it has sent, and answer */
    VISOD_EVENT_CONNECTED = 2, /* a subscriber's answer */
    VISOD_EVENT_MAX = 7
};

enum visod_status {
    VISOD_INITIALIZING = 0,
    VISOD_TRACKING = 1,
    VISOD_DEGRADED = 2,
    VISOD_LOST = 3
};

enum visod_frame {
    VISOD_LEFT_CAMERA = 0, /* x right, y down, z forward */
    VISOD_BASE = 1         /* x forward, y left, z up */
};

/* Bits of flags. */
enum visod_flags {
    VISOD_REPLAY = 1,             /* realtime_ns is a recording's own stamp, monotonic_ns is 0 */
    VISOD_MONOTONIC = 2,          /* monotonic_ns holds the capture time */
    VISOD_BEYOND_FIRST_ORDER = 4  /* the covariance does not describe the pose's error any more */
};

enum visod_camera_state {
    VISOD_CLOSED = 0,
    VISOD_OPENING = 1,
    VISOD_STREAMING = 2,
    VISOD_STALLED = 3,
    VISOD_CAMERA_LOST = 4
};

enum visod_rig_state {
    VISOD_UNWATCHED = 0,
    VISOD_GOOD = 1,
    VISOD_MOVED = 2,
    VISOD_MISFITS = 3
};

/* visod/odometry: one estimate. */
typedef struct visod_odometry_message {
    uint32_t magic;                        /* 0: 0x444F_4956, the bytes VIOD */
    uint32_t version;                      /* 4: of this layout: 1 */
    uint32_t size;                         /* 8: of this layout, bytes */
    uint32_t flags;                        /* 12: see enum visod_flags */
    uint64_t sequence;                     /* 16: number of the stereo pair in its recording, or since the start */
    uint64_t message_number;               /* 24: of this publisher, from 0 without gaps: a gap is a lost message */
    int64_t realtime_ns;                   /* 32: when the left image was taken, CLOCK_REALTIME; a recording's own stamp in a replay */
    int64_t monotonic_ns;                  /* 40: the same instant, CLOCK_MONOTONIC; 0 in a replay */
    int64_t published_monotonic_ns;        /* 48: when the message was handed over, CLOCK_MONOTONIC */
    uint32_t epoch;                        /* 56: rises whenever the odometry frame begins anew */
    uint32_t status;                       /* 60: 0 initializing, 1 tracking, 2 degraded, 3 lost */
    uint32_t frame;                        /* 64: whose pose this is: 0 left camera (x right, y down, z forward), 1 robot base */
    uint32_t budget_modelled;              /* 68: bit i: part i of the error budget is modelled; others are zero */
    uint32_t keypoints_left;               /* 72: keypoints of the left image */
    uint32_t keypoints_right;              /* 76: keypoints of the right image */
    uint32_t stereo_matches;               /* 80: left–right matches */
    uint32_t tracks;                       /* 84: stereo matches found again from the pair before */
    uint32_t inliers;                      /* 88: tracks that the estimate rests on */
    uint32_t undetermined;                 /* 92: axes of the motion that the images leave open, as bits: 1, 2, 4 along x, y, z of the frame (σ above 0.1 m); 8, 16, 32 about them (above 0.01 rad); 63 where it was bridged */
    double variance_factor;                /* 96: a-posteriori variance factor; not a number where nothing was measured */
    double position_m[3];                  /* 104: of the frame in the odometry frame, m */
    double orientation_xyzw[4];            /* 128: of the frame in the odometry frame */
    double motion_translation_m[3];        /* 160: since the pair before, in the frame then, m */
    double motion_rotation_xyzw[4];        /* 184: since the pair before */
    double twist[6];                       /* 216: velocity in the frame itself: m/s, then rad/s */
    double cov_pose[36];                   /* 264: of the pose, row by row */
    double cov_motion[36];                 /* 552: of the motion, row by row */
    double cov_twist[36];                  /* 840: of the velocity, row by row */
    double budget_detection[21];           /* 1128: part 0 of cov_pose: from the detection of keypoints */
    double budget_calibration[21];         /* 1296: part 1: from the calibration of the rig */
    double budget_synchronisation[21];     /* 1464: part 2: from images not taken at the same instant */
    double budget_bridging[21];            /* 1632: part 3: from motions that had to be bridged */
    uint64_t latency_capture_ns;           /* 1800: exposure to pair complete; 0 where not measured, here and below */
    uint64_t latency_features_ns;          /* 1808: detection and description */
    uint64_t latency_matching_ns;          /* 1816: left–right and over time */
    uint64_t latency_estimation_ns;        /* 1824: triangulation to pose */
    uint64_t latency_total_ns;             /* 1832: pair complete to message ready */
    double innovation_ratio;               /* 1840: of the noise model: below 0.5 fine, above 1 it does not hold; not a number where nothing was measured */
} visod_odometry_message;

/* One feature that an estimate rests on. */
typedef struct visod_feature {
    uint64_t id;                           /* 0: names the point for as long as it is followed */
    uint32_t age;                          /* 8: pairs before this one that showed it; 0 where it is new */
    uint32_t reserved;                     /* 12: 0 */
    float left_px[2];                      /* 16: where the left image shows it, x to the right, y down; 0 is the middle of the first pixel */
    float right_px[2];                     /* 24: where the right image shows it */
    double point_m[3];                     /* 32: where it is in the left camera (x right, y down, z forward), m */
    double cov_m2[6];                      /* 56: of the point by the noise of pixels, the cameras' poses being given: xx, xy, xz, yy, yz, zz, m² */
} visod_feature;

/* visod/features: those of one pair; the first count are in use. */
typedef struct visod_features_message {
    uint32_t magic;                        /* 0: 0x464F_4956, the bytes VIOF */
    uint32_t version;                      /* 4: of this layout: 1 */
    uint32_t size;                         /* 8: of this layout, bytes */
    uint32_t flags;                        /* 12: as in visod/odometry */
    uint64_t sequence;                     /* 16: number of the stereo pair, as in visod/odometry */
    uint64_t message_number;               /* 24: of this publisher, from 0 without gaps: a gap is a lost message */
    int64_t realtime_ns;                   /* 32: as in visod/odometry */
    int64_t monotonic_ns;                  /* 40: as in visod/odometry */
    int64_t published_monotonic_ns;        /* 48: when the message was handed over, CLOCK_MONOTONIC */
    uint32_t epoch;                        /* 56: as in visod/odometry */
    uint32_t status;                       /* 60: as in visod/odometry */
    uint32_t count;                        /* 64: entries of features in use, at most 512 */
    uint32_t left_out;                     /* 68: features of the pair for which there was no room */
    double position_m[3];                  /* 72: of the left camera in the odometry frame, m, whatever visod/odometry is about */
    double orientation_xyzw[4];            /* 96: of the left camera in the odometry frame */
    visod_feature features[512];           /* 128: see below, with rising id */
} visod_features_message;

/* visod/health: how the daemon is, every second and on change. */
typedef struct visod_health_message {
    uint32_t magic;                        /* 0: 0x484F_4956, the bytes VIOH */
    uint32_t version;                      /* 4: of this layout: 1 */
    uint32_t size;                         /* 8: of this layout, bytes */
    uint32_t odometry_status;              /* 12: status of the last estimate, as in visod/odometry */
    uint64_t message_number;               /* 16: of this publisher, from 0 without gaps */
    int64_t realtime_ns;                   /* 24: when this was written, CLOCK_REALTIME */
    int64_t monotonic_ns;                  /* 32: the same instant, CLOCK_MONOTONIC */
    uint32_t left_state;                   /* 40: see enum visod_camera_state */
    uint32_t right_state;                  /* 44: see enum visod_camera_state */
    uint64_t left_frames;                  /* 48: images received */
    uint64_t right_frames;                 /* 56: images received */
    uint64_t left_reconnects;              /* 64: times that the camera had to be opened again */
    uint64_t right_reconnects;             /* 72: times that the camera had to be opened again */
    int64_t left_last_monotonic_ns;        /* 80: when the last image arrived, CLOCK_MONOTONIC; 0 before the first */
    int64_t right_last_monotonic_ns;       /* 88: when the last image arrived, CLOCK_MONOTONIC; 0 before the first */
    uint64_t left_lost_in_transport;       /* 96: images that the camera sent but that arrived not or not whole */
    uint64_t right_lost_in_transport;      /* 104: images that the camera sent but that arrived not or not whole */
    uint64_t left_unreadable;              /* 112: images that could not be decoded or had the wrong size */
    uint64_t right_unreadable;             /* 120: images that could not be decoded or had the wrong size */
    uint64_t left_unmatched;               /* 128: images without a partner from the other camera */
    uint64_t right_unmatched;              /* 136: images without a partner from the other camera */
    uint64_t pairs_processed;              /* 144: stereo pairs that gave an estimate */
    uint64_t pairs_unusable;               /* 152: stereo pairs that could not be handed on */
    uint64_t pairs_dropped;                /* 160: stereo pairs dropped because the stages were busy */
    uint64_t pairs_degraded;               /* 168: estimates of status degraded */
    uint64_t pairs_lost;                   /* 176: estimates of status lost */
    uint64_t restarts;                     /* 184: times that the odometry frame began anew */
    uint64_t over_budget;                  /* 192: pairs that took the stages longer than budget_ns; they overlap, so that this alone delays nothing */
    uint64_t publish_failures;             /* 200: messages that could not be handed over */
    uint64_t budget_ns;                    /* 208: time between two pairs that the stages may use; 0 without one */
    uint64_t busy_mean_ns;                 /* 216: time used a pair, mean since the last of these messages */
    uint64_t busy_max_ns;                  /* 224: time used a pair, greatest since the last of these messages */
    uint64_t uptime_ns;                    /* 232: since the daemon's start */
    uint64_t subscribers;                  /* 240: subscribers of visod/odometry */
    uint32_t degraded_mode;                /* 248: 0 none, 1 fewer features are looked for, since pairs had to wait */
    uint32_t features_permille;            /* 252: share of the features that is looked for, thousandths */
    uint64_t overruns;                     /* 256: pairs whose estimate came after the deadline */
    uint32_t rig_state;                    /* 264: see enum visod_rig_state */
    int32_t rig_pitch_nrad;                /* 268: turn of the right camera since the start, about its x axis, 1e-9 rad */
    int32_t rig_yaw_nrad;                  /* 272: the same, about its y axis */
    int32_t rig_roll_nrad;                 /* 276: the same, about its z axis */
} visod_health_message;

VISOD_ASSERT(sizeof(visod_odometry_message) == 1848, "layout of visod/odometry");
VISOD_ASSERT(sizeof(visod_feature) == 104, "layout of a feature");
VISOD_ASSERT(sizeof(visod_features_message) == 53376, "layout of visod/features");
VISOD_ASSERT(sizeof(visod_health_message) == 280, "layout of visod/health");

#ifdef __cplusplus
}
#endif

#endif
