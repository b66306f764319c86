/* `my-filter`: the last fix, carried on at its velocity. A filter in C: the folder of one run in, its answer out. To change.

   cc -O2 -o my-filter my-filter.c -lm
   ./my-filter LOGS/000000 > LOGS/answers/my-filter/000000.csv */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { TIME, LAT, LON, ALT, NORTH, EAST, DOWN, COLUMNS };

/* A table of the log, its header read over. */
static FILE *table(const char *folder, const char *name) {
    char path[4096];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "r");
    if (!file) {
        perror(path);
        exit(1);
    }
    fscanf(file, "%*[^\n]");
    return file;
}

/* The first seven columns of the next row, the same in initial.csv and gnss.csv; 0 where there is none. */
static int row(FILE *file, double *x) {
    int n = fscanf(file, "%lf,%lf,%lf,%lf,%lf,%lf,%lf%*[^\n]", x, x + 1, x + 2, x + 3, x + 4, x + 5, x + 6);
    return n == COLUMNS;
}

int main(int argc, char **argv) {
    const double degree = acos(-1.0) / 180.0, radius = 6.37e6; /* of the Earth, m */
    double fix[COLUMNS], next[COLUMNS], t;
    if (argc != 2) {
        fprintf(stderr, "usage: %s FOLDER_OF_A_RUN > ANSWER.csv\n", argv[0]);
        return 2;
    }
    FILE *imu = table(argv[1], "imu.csv"), *gnss = table(argv[1], "gnss.csv");
    if (!row(table(argv[1], "initial.csv"), fix)) return 1;
    int more = row(gnss, next);
    puts("time_s,lat_deg,lon_deg,alt_m,v_north_mps,v_east_mps,v_down_mps");
    while (fscanf(imu, "%lf%*[^\n]", &t) == 1) {
        while (more && next[TIME] <= t) {
            memcpy(fix, next, sizeof fix);
            more = row(gnss, next);
        }
        double age = t - fix[TIME];
        double lat = fix[LAT] + fix[NORTH] * age / radius / degree;
        double lon = fix[LON] + fix[EAST] * age / (radius * cos(fix[LAT] * degree)) / degree;
        printf("%.9f,%.10f,%.10f,%.6f,", t, lat, lon, fix[ALT] - fix[DOWN] * age);
        printf("%.6f,%.6f,%.6f\n", fix[NORTH], fix[EAST], fix[DOWN]);
    }
    return 0;
}
