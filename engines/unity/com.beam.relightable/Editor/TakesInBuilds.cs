using System.IO;
using UnityEditor;
using UnityEditor.Build;

namespace Beam.Relightable.Editor {
    /// <summary>Puts the containers of all imported takes among the streaming assets of a build.</summary>
    public sealed class TakesInBuilds : BuildPlayerProcessor {
        public override void PrepareForBuild(BuildPlayerContext context) {
            foreach (string guid in AssetDatabase.FindAssets("t:TakeAsset")) {
                var asset = AssetDatabase.LoadAssetAtPath<TakeAsset>(AssetDatabase.GUIDToAssetPath(guid));
                if (asset == null || asset.rows.Length > 0) continue;
                context.AddAdditionalPathToStreamingAssets(Path.GetFullPath(asset.sourcePath), asset.BuildName);
            }
        }
    }
}
