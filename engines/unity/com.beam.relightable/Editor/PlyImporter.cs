using System;
using System.Collections.Generic;
using System.IO;
using UnityEditor.AssetImporters;

namespace Beam.Relightable.Editor {
    /// <summary>Imports a PLY that was written with --profile beam, where this importer is chosen for it.</summary>
    [ScriptedImporter(1, null, new[] { "ply" })]
    public sealed class PlyImporter : ScriptedImporter {
        public override void OnImportAsset(AssetImportContext context) {
            try {
                Dictionary<string, float[]> frame = PlyFrame.Read(context.assetPath);
                int count = frame["opacities"].Length;
                TakeAsset asset = Imported.Asset(frame, count);
                asset.frames = 1;
                asset.rate = 1f;
                asset.rows = Imported.Rows(frame, count);
                context.AddObjectToAsset("take", asset);
                context.SetMainObject(asset);
            } catch (Exception error) when (error is DeliveryException || error is IOException) {
                context.LogImportError(error.Message);
            }
        }
    }
}
