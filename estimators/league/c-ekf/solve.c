/* A loosely coupled INS/GNSS filter in C: the folder of one run in, its answer out (docs/howto/external.md).

   cc -O2 -o solve solve.c -lm
   ./solve LOGS/000000 > ANSWER.csv

   Strapdown in north-east-down and a 15-state closed-loop error-state Kalman filter: Groves, 2nd ed., sections 5.4 and 14.2. Errors
   are truth minus estimate, in the order position (m), velocity, rotation vector in n, accelerometer bias, gyro bias; a
   fix is six scalar updates at its own time. Noise comes from log.json: the larger of random walk and rounding to one bit, and
   biases as random walks that grow as the Gauss-Markov process of the data sheet does at first. SI units and radians. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { P = 0, V = 3, A = 6, BA = 9, BG = 12, N = 15, LONGEST = 65536, MOST = 64 };
static const double RATE = 7.292115e-5, MAJOR = 6378137.0, E2 = 0.00669437999014;
static const double SAME_TIME = 1e-7; /* s */
static const double DEGREE = 0.017453292519943295;
static const double PEAK = 0.61736; /* of the Allan deviation of a Gauss-Markov process, over its sigma: IEEE Std 952-1997, C.16 */

typedef struct {
    FILE *file;
    int columns;
    char *names[MOST];
    double row[MOST];
} Table;

typedef struct {
    double white, drive; /* spectral densities of the noise and of what drives the bias */
} Triad;

typedef struct {
    double t, lat, lon, h, v[3], q[4], ba[3], bg[3], cov[N][N];
} Filter;

static void fail(const char *what, const char *which) {
    fprintf(stderr, "%s: %s\n", which, what);
    exit(1);
}

/* ---- files */

static char *join(const char *folder, const char *name) {
    static char path[4096];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    return path;
}

static Table open_table(const char *folder, const char *name) {
    static char line[LONGEST];
    Table table = {fopen(join(folder, name), "r"), 0, {0}, {0}};
    if (!table.file || !fgets(line, sizeof line, table.file)) fail("cannot be read", name);
    for (char *word = strtok(line, ",\r\n"); word && table.columns < MOST; word = strtok(NULL, ",\r\n"))
        table.names[table.columns++] = strdup(word);
    return table;
}

static int next_row(Table *table) {
    static char line[LONGEST];
    if (!fgets(line, sizeof line, table->file)) return 0;
    char *place = line;
    for (int k = 0; k < table->columns; k++) {
        table->row[k] = strtod(place, &place);
        if (*place == ',') place++;
    }
    return 1;
}

/* The value of a column in the present row, or another one where there is no such column. */
static double value(const Table *table, const char *name, double otherwise) {
    for (int k = 0; k < table->columns; k++)
        if (!strcmp(table->names[k], name)) return table->row[k];
    if (isnan(otherwise)) fail("column is missing", name);
    return otherwise;
}

static double need(const Table *table, const char *name) { return value(table, name, NAN); }

static char *read_all(const char *path) {
    FILE *file = fopen(path, "r");
    if (!file) fail("cannot be read", path);
    fseek(file, 0, SEEK_END);
    long size = ftell(file);
    rewind(file);
    char *text = calloc(size + 1, 1);
    if (fread(text, 1, size, file) != (size_t)size) fail("cannot be read", path);
    fclose(file);
    return text;
}

/* The object or number behind a key, from a place of log.json on: its keys stand in one order. */
static const char *behind(const char *text, const char *key) {
    char quoted[64];
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    const char *found = text ? strstr(text, quoted) : NULL;
    if (!found) fail("key is missing in log.json", key);
    return found + strlen(quoted);
}

static double number(const char *text, const char *key) { return strtod(behind(text, key), NULL); }

/* ---- arithmetic of rotations and the Earth */

static void cross(const double *a, const double *b, double *c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static void multiply(const double *p, const double *q, double *r) {
    r[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3];
    r[1] = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2];
    r[2] = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1];
    r[3] = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0];
}

static void quaternion(const double *rotation, double *q) {
    double angle = sqrt(rotation[0] * rotation[0] + rotation[1] * rotation[1] + rotation[2] * rotation[2]);
    double s = angle > 1e-9 ? sin(0.5 * angle) / angle : 0.5;
    q[0] = cos(0.5 * angle);
    for (int i = 0; i < 3; i++) q[1 + i] = s * rotation[i];
}

static void turn(Filter *f, const double *left, const double *right) {
    double l[4], r[4], half[4], q[4], norm = 0.0;
    quaternion(left, l);
    quaternion(right, r);
    multiply(f->q, r, half);
    multiply(l, half, q);
    for (int i = 0; i < 4; i++) norm += q[i] * q[i];
    for (int i = 0; i < 4; i++) f->q[i] = q[i] / sqrt(norm);
}

static void matrix(const double *q, double c[3][3]) {
    double w = q[0], x = q[1], y = q[2], z = q[3];
    double m[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                      {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                      {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
    memcpy(c, m, sizeof m);
}

static void rotate(double c[3][3], const double *b, double *n) {
    for (int i = 0; i < 3; i++) n[i] = c[i][0] * b[0] + c[i][1] * b[1] + c[i][2] * b[2];
}

static void radii(double lat, double *meridian, double *normal) {
    double w = 1.0 - E2 * sin(lat) * sin(lat);
    *meridian = MAJOR * (1.0 - E2) / (w * sqrt(w));
    *normal = MAJOR / sqrt(w);
}

/* Somigliana's formula, with the free-air term to second order: WGS-84. */
static double gravity(double lat, double h) {
    double s2 = sin(lat) * sin(lat);
    double surface = 9.7803253359 * (1.0 + 0.001931853 * s2) / sqrt(1.0 - E2 * s2);
    return surface * (1.0 - 2.0 / MAJOR * (1.0 + 0.0033528107 * (1.0 - 2.0 * s2) + 0.00344979) * h + 3.0 * h * h / MAJOR / MAJOR);
}

/* ---- the filter */

/* P = F P F' + Q over dt: F differs from one in the rows of position, velocity and attitude. */
static void carry(Filter *f, const double *force, double c[3][3], const double *spin, double dt, Triad accel, Triad gyro) {
    static double step[N][N], half[N][N];
    memset(step, 0, sizeof step);
    for (int i = 0; i < N; i++) step[i][i] = 1.0;
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        step[P + i][V + i] = dt;
        step[V + i][A + j] = force[k] * dt; /* -[force x] */
        step[V + i][A + k] = -force[j] * dt;
        step[A + i][A + j] = spin[k] * dt; /* -[spin x] */
        step[A + i][A + k] = -spin[j] * dt;
        for (int m = 0; m < 3; m++) {
            step[V + i][BA + m] = -c[i][m] * dt;
            step[A + i][BG + m] = -c[i][m] * dt;
        }
    }
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) {
            double sum = f->cov[i][j];
            if (i < BA) {
                sum = 0.0;
                for (int k = i < V ? P : V; k < N; k++) sum += step[i][k] * f->cov[k][j];
            }
            half[i][j] = sum;
        }
    for (int i = 0; i < N; i++)
        for (int j = i; j < N; j++) {
            double sum = half[i][j];
            if (j < BA) {
                sum = 0.0;
                for (int k = j < V ? P : V; k < N; k++) sum += half[i][k] * step[j][k];
            }
            f->cov[i][j] = f->cov[j][i] = sum;
        }
    for (int i = 0; i < 3; i++) {
        f->cov[V + i][V + i] += accel.white * dt;
        f->cov[A + i][A + i] += gyro.white * dt;
        f->cov[BA + i][BA + i] += accel.drive * dt;
        f->cov[BG + i][BG + i] += gyro.drive * dt;
    }
}

/* On to the time `until` with one sample's means; angular rate about n afterwards in `rate`, for the lever arm. */
static void advance(Filter *f, double until, const double *gyro_b, const double *accel_b, Triad accel, Triad gyro, double *rate) {
    double dt = until - f->t, w[3], force_b[3], c[3][3], half[3], middle[4], turned[4], force[3], meridian, normal;
    for (int i = 0; i < 3; i++) {
        w[i] = gyro_b[i] - f->bg[i];
        force_b[i] = accel_b[i] - f->ba[i];
        rate[i] = w[i];
        half[i] = 0.5 * dt * w[i];
    }
    if (dt < SAME_TIME) return;
    radii(f->lat, &meridian, &normal);
    double north = RATE * cos(f->lat), down = -RATE * sin(f->lat);
    double transport[3] = {f->v[1] / (normal + f->h), -f->v[0] / (meridian + f->h), 0.0};
    transport[2] = -transport[0] * tan(f->lat);
    double spin[3] = {north + transport[0], transport[1], down + transport[2]};
    double both[3] = {spin[0] + north, spin[1], spin[2] + down}, coriolis[3], v[3], right[3], left[3];

    quaternion(half, middle); /* specific force with the attitude of the step's middle */
    multiply(f->q, middle, turned);
    matrix(turned, c);
    rotate(c, force_b, force);
    cross(both, f->v, coriolis);
    double g = gravity(f->lat, f->h);
    for (int i = 0; i < 3; i++) v[i] = f->v[i] + dt * (force[i] - coriolis[i] + (i == 2 ? g : 0.0));
    f->h -= 0.5 * dt * (f->v[2] + v[2]);
    double lat = f->lat + 0.5 * dt * (f->v[0] + v[0]) / (meridian + f->h);
    f->lon += 0.5 * dt * (f->v[1] + v[1]) / ((normal + f->h) * cos(0.5 * (lat + f->lat)));
    f->lat = lat;
    memcpy(f->v, v, sizeof v);
    for (int i = 0; i < 3; i++) {
        right[i] = dt * w[i];
        left[i] = -dt * spin[i];
    }
    turn(f, left, right);
    carry(f, force, c, spin, dt, accel, gyro);
    f->t = until;
}

/* One scalar measurement: residual = row . error + noise of variance r. Errors are gathered in `error`. */
static void update(Filter *f, const double *row, double residual, double r, double *error) {
    double ph[N], s = r;
    for (int i = 0; i < N; i++) {
        ph[i] = 0.0;
        for (int j = 0; j < N; j++) ph[i] += f->cov[i][j] * row[j];
    }
    for (int i = 0; i < N; i++) {
        s += row[i] * ph[i];
        residual -= row[i] * error[i];
    }
    for (int i = 0; i < N; i++) error[i] += ph[i] / s * residual;
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) f->cov[i][j] -= ph[i] * ph[j] / s;
}

/* Position and velocity of an antenna at the end of a lever arm. */
static void take_fix(Filter *f, const double *fix, const double *variance, const double *lever, const double *rate) {
    double c[3][3], arm[3], sweep_b[3], sweep[3], meridian, normal, error[N] = {0}, none[3] = {0};
    matrix(f->q, c);
    rotate(c, lever, arm);
    cross(rate, lever, sweep_b);
    rotate(c, sweep_b, sweep);
    radii(f->lat, &meridian, &normal);
    double east = remainder(fix[1] - f->lon, 360.0 * DEGREE);
    double off[6] = {(fix[0] - f->lat) * (meridian + f->h) - arm[0], east * (normal + f->h) * cos(f->lat) - arm[1],
                     f->h - fix[2] - arm[2]};
    for (int i = 0; i < 3; i++) off[3 + i] = fix[3 + i] - f->v[i] - sweep[i];
    for (int m = 0; m < 6; m++) {
        const double *a = m < 3 ? arm : sweep;
        int i = m % 3, j = (i + 1) % 3, k = (i + 2) % 3;
        double row[N] = {0};
        row[m] = 1.0;
        row[A + j] = a[k]; /* -[a x] */
        row[A + k] = -a[j];
        update(f, row, off[m], variance[m], error);
    }
    f->lat += error[P] / (meridian + f->h);
    f->lon += error[P + 1] / ((normal + f->h) * cos(f->lat));
    f->h -= error[P + 2];
    for (int i = 0; i < 3; i++) {
        f->v[i] += error[V + i];
        f->ba[i] += error[BA + i];
        f->bg[i] += error[BG + i];
    }
    turn(f, error + A, none);
}

/* ---- from the log to the filter */

static const char *AXES[3] = {"north", "east", "down"}, *BODY[3] = {"x", "y", "z"};

static double of_axis(const Table *table, const char *pattern, const char *axis, double otherwise) {
    char name[64];
    snprintf(name, sizeof name, pattern, axis);
    return value(table, name, otherwise);
}

static Filter begin(const Table *start) {
    const char *groups[5] = {"std_position_%s_m", "std_velocity_%s_mps", "std_attitude_%s_rad", "std_accel_bias_%s_mps2",
                             "std_gyro_bias_%s_radps"};
    const double least[5] = {1e-3, 1e-4, 1e-6, 1e-6, 1e-9}; /* of a start that is exact: a filter needs a little */
    Filter f = {need(start, "time_s"), need(start, "lat_rad"), need(start, "lon_rad"), need(start, "alt_m"), {0}, {0}, {0}, {0}, {{0}}};
    for (int i = 0; i < 3; i++) {
        f.v[i] = of_axis(start, "v_%s_mps", AXES[i], NAN);
        f.ba[i] = of_axis(start, "accel_bias_%s_mps2", BODY[i], NAN);
        f.bg[i] = of_axis(start, "gyro_bias_%s_radps", BODY[i], NAN);
        for (int g = 0; g < 5; g++) {
            double sigma = fmax(of_axis(start, groups[g], g < 3 ? AXES[i] : BODY[i], NAN), least[g]);
            f.cov[3 * g + i][3 * g + i] = sigma * sigma;
        }
    }
    const char *q[4] = {"q_nb_0", "q_nb_1", "q_nb_2", "q_nb_3"};
    for (int i = 0; i < 4; i++) f.q[i] = need(start, q[i]);
    return f;
}

static Triad triad(const char *spec, double dt) {
    double walk = number(spec, "white_noise"), bit = number(spec, "resolution");
    double sigma = number(spec, "bias_instability") / PEAK, random_walk = number(spec, "rate_random_walk");
    Triad made = {fmax(walk * walk, bit * bit / 12.0 * dt),
                  2.0 * sigma * sigma / number(spec, "correlation_time_s") + random_walk * random_walk};
    return made;
}

/* The next fix: latitude, longitude (rad), height, velocity, and its variances; the time that it describes, or infinity. */
static double next_fix(Table *gnss, const double *sigma, double latency, double *fix, double *variance) {
    if (!next_row(gnss)) return INFINITY;
    fix[0] = need(gnss, "lat_deg") * DEGREE;
    fix[1] = need(gnss, "lon_deg") * DEGREE;
    fix[2] = need(gnss, "alt_m");
    for (int i = 0; i < 3; i++) {
        double place = fmax(of_axis(gnss, "std_%s_m", AXES[i], sigma[i]), 1e-3);
        double speed = fmax(of_axis(gnss, "std_v_%s_mps", AXES[i], sigma[3 + i]), 1e-4);
        fix[3 + i] = of_axis(gnss, "v_%s_mps", AXES[i], NAN);
        variance[i] = place * place;
        variance[3 + i] = speed * speed;
    }
    return need(gnss, "time_s") - latency;
}

static void print_answer(const Filter *f) {
    printf("%.9f,%.12g,%.12g,%.6f", f->t, f->lat / DEGREE, remainder(f->lon, 360.0 * DEGREE) / DEGREE, f->h);
    for (int i = 0; i < 3; i++) printf(",%.7g", f->v[i]);
    for (int i = 0; i < 4; i++) printf(",%.12g", f->q[i]);
    for (int i = 0; i < BA; i++) printf(",%.6g", sqrt(f->cov[i][i]));
    putchar('\n');
}

int main(int argc, char **argv) {
    if (argc != 2) fail("usage: solve FOLDER_OF_A_RUN > ANSWER.csv", "solve");
    const char *meta = read_all(join(argv[1], "log.json")), *imu_spec = behind(meta, "imu"), *spec = behind(meta, "gnss");
    Table imu = open_table(argv[1], "imu.csv"), gnss = open_table(argv[1], "gnss.csv"), start = open_table(argv[1], "initial.csv");
    if (!next_row(&start)) fail("holds no row", "initial.csv");
    Filter f = begin(&start);
    double dt = 1.0 / number(imu_spec, "rate_hz"), latency = number(spec, "latency_s"), rate[3];
    Triad gyro = triad(behind(imu_spec, "gyro"), dt), accel = triad(behind(imu_spec, "accel"), dt);
    double level = hypot(number(spec, "horizontal_sigma"), number(spec, "horizontal_markov_sigma"));
    double up = hypot(number(spec, "vertical_sigma"), number(spec, "vertical_markov_sigma"));
    double speed = number(spec, "velocity_sigma"), sigma[6] = {level, level, up, speed, speed, speed};
    double lever[3], fix[6], variance[6];
    const char *arm = strchr(behind(spec, "lever_arm_b"), '[');
    for (int i = 0; i < 3; i++) {
        char *end;
        lever[i] = strtod(arm + 1, &end);
        arm = strpbrk(end, ",]");
    }
    double due = next_fix(&gnss, sigma, latency, fix, variance);
    while (due < f.t - SAME_TIME) due = next_fix(&gnss, sigma, latency, fix, variance);
    printf("time_s,lat_deg,lon_deg,alt_m,v_north_mps,v_east_mps,v_down_mps,q_nb_0,q_nb_1,q_nb_2,q_nb_3");
    const char *groups[3] = {",std_position_%s_m", ",std_velocity_%s_mps", ",std_attitude_%s_rad"};
    for (int g = 0; g < 3; g++)
        for (int i = 0; i < 3; i++) printf(groups[g], AXES[i]);
    putchar('\n');
    while (next_row(&imu)) {
        double t = need(&imu, "time_s"), w[3], a[3];
        for (int i = 0; i < 3; i++) {
            w[i] = of_axis(&imu, "gyro_%s_radps", BODY[i], NAN);
            a[i] = of_axis(&imu, "accel_%s_mps2", BODY[i], NAN);
        }
        while (due <= t + SAME_TIME) {
            advance(&f, fmin(due, t), w, a, accel, gyro, rate);
            take_fix(&f, fix, variance, lever, rate);
            due = next_fix(&gnss, sigma, latency, fix, variance);
        }
        advance(&f, t, w, a, accel, gyro, rate);
        f.t = t;
        print_answer(&f);
    }
    return 0;
}
