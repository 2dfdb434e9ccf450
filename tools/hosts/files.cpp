// Scene → edits, export, mesh, list of things: files for other programs.
//   files SCENE OUT  OUT/scene.ply, OUT/scene.glb, OUT/things; the edit is undone at the end
#include "host.hpp"

struct EndEditor {
    void operator()(SvkEditor *editor) const { svk_editor_destroy(editor); }
};

static void check_edit(SvkStatus status, const SvkEditor *editor) {
    if (status != SVK_STATUS_OK) throw std::runtime_error(last_error(svk_editor_error, editor));
}

// Prints the name of every stage and counts them; anything but 0 would stop the work.
static int32_t progress(void *stages, const SvkProgress *p) {
    if (p->kind == SVK_PROGRESS_KIND_BEGIN) {
        std::printf("%s\n", p->stage);
        ++*static_cast<int *>(stages);
    }
    return 0;
}

static int run(const std::string &path, const std::string &out) {
    SvkContext *made = nullptr;
    check(svk_context_create(nullptr, &made), made);
    Context context(made);

    SvkEditor *opened = nullptr;
    check(svk_editor_open(made, path.c_str(), &opened), made);
    std::unique_ptr<SvkEditor, EndEditor> editor(opened);
    // A word may be doubtful; then nothing is changed, and a range of opacities is taken instead.
    auto edit = make<SvkEdit>();
    edit.operation = SVK_OPERATION_DELETE;
    edit.selection = "lemon";
    auto edited = make<SvkEdited>();
    SvkStatus status = svk_editor_edit(opened, &edit, &edited);
    if (status == SVK_STATUS_DOUBTFUL || status == SVK_STATUS_INPUT) {
        std::printf("%s\n", last_error(svk_editor_error, opened).c_str());
        edit.selection = "opacity<0.1";
        status = svk_editor_edit(opened, &edit, &edited);
    }
    check_edit(status, opened);
    std::printf("%llu splats deleted, %.1f %% of the scene\n", static_cast<unsigned long long>(edited.splats),
                100 * edited.share);

    SvkScene *present = nullptr;
    check_edit(svk_editor_scene(opened, &present), opened);
    Scene scene(present);
    char summary[500];
    auto exporting = make<SvkExportOptions>();
    exporting.replace = 1;
    check(svk_scene_export(present, (out + "/scene.ply").c_str(), &exporting, summary, sizeof summary), present);
    std::printf("scene.ply: %s\n", summary);

    int stages = 0;
    auto meshing = make<SvkMeshOptions>();
    meshing.triangles = 20000;
    meshing.replace = 1;
    meshing.progress = progress;
    meshing.user = &stages;
    auto info = make<SvkMeshInfo>();
    check(svk_scene_mesh(present, (out + "/scene.glb").c_str(), &meshing, &info), present);
    std::printf("scene.glb: %llu triangles, %s\n", static_cast<unsigned long long>(info.triangles),
                info.upright ? "upright" : "up is not known");

    auto listing = make<SvkObjectsOptions>();
    listing.vocabulary = "lemon\nblue mug\nplate";
    listing.replace = 1;
    size_t count = 0;
    check(svk_scene_objects(present, (out + "/things").c_str(), &listing, &count), present);
    std::printf("things: %zu, with their parts\n", count);

    size_t undone = 0;
    check_edit(svk_editor_undo(opened, 1, &undone), opened);
    return undone == 1 && stages > 0 && info.triangles > 0 && info.triangles <= 20000 ? 0 : 1;
}

int main(int argc, char **argv) {
    if (argc != 3) {
        std::fprintf(stderr, "usage: files SCENE OUT\n");
        return 2;
    }
    try {
        return run(argv[1], argv[2]);
    } catch (const std::exception &e) {
        std::fprintf(stderr, "files: %s\n", e.what());
        return 1;
    }
}
